"""A run as an MCAP file: messages of all topics in the order of their times."""

import io
from dataclasses import dataclass, replace

from slipid.app.run_export.run_messages import messages
from slipid.app.run_export.run_view import RunView
from slipid.support.checkpoint import versions
from slipid.support.extras import require


@dataclass(frozen=True)
class McapTopic:
    """A topic of a file.

    Attributes:
        name: name of the topic.
        schema: full name of the schema of its messages.
        unit: unit of its numbers.
        messages: number of its messages.
    """

    name: str
    schema: str
    unit: str
    messages: int


@dataclass(frozen=True, eq=False)
class McapFile:
    """An MCAP file in memory.

    Attributes:
        data: bytes of the file.
        topics: its topics, sorted by name.
    """

    data: bytes
    topics: tuple[McapTopic, ...]


def require_mcap() -> None:
    """Raise `MissingExtra` if a package that writes MCAP files is missing."""
    for package in ("mcap_protobuf", "foxglove_schemas_protobuf"):
        require(package, "mcap", "an MCAP file")


def mcap_of(view: RunView) -> McapFile:
    """Return the MCAP file of a run.

    Raises:
        MissingExtra: a package that writes MCAP files is missing.
    """
    require_mcap()
    from mcap.well_known import MessageEncoding
    from mcap.writer import Writer
    from mcap_protobuf.schema import register_schema

    buffer = io.BytesIO()
    writer = Writer(buffer)
    writer.start(library=f"slipid {versions()['slipid']}")
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    topics: dict[str, McapTopic] = {}
    begin = min(0.0, float(view.log.time[0]))  # times of messages are not negative
    for one in sorted(messages(view), key=lambda one: one.time):
        name, kind = one.channel.topic, one.content.DESCRIPTOR.full_name
        if kind not in schemas:
            schemas[kind] = register_schema(writer, type(one.content))
        if name not in topics:
            about = {"unit": one.channel.unit, "meaning": one.channel.meaning}
            new = name, MessageEncoding.Protobuf, schemas[kind], about
            channels[name] = writer.register_channel(*new)
            topics[name] = McapTopic(name, kind, one.channel.unit, 0)
        time = round(1e9 * (one.time - begin))
        if "timestamp" in one.content.DESCRIPTOR.fields_by_name:
            one.content.timestamp.FromNanoseconds(time)
        data = one.content.SerializeToString(deterministic=True)
        writer.add_message(channels[name], log_time=time, data=data, publish_time=time)
        topics[name] = replace(topics[name], messages=topics[name].messages + 1)
    writer.add_metadata("slipid", _about(view))
    writer.finish()
    return McapFile(buffer.getvalue(), tuple(topics[name] for name in sorted(topics)))


def _about(view: RunView) -> dict[str, str]:
    """Return the metadata of the file, which tells where its numbers come from."""
    log = view.log
    return {
        "run": log.name,
        "sha256": log.sha256,
        "fitted": view.fitted,
        "floor": log.surface or "unknown",
        "load": log.load,
        "selected_model": view.selected or "none",
        "notes": "\n".join(view.notes),
        "slipid": versions()["slipid"],
    }
