"""The one error about a bag that rosbags cannot read, with what mends it."""

from slipid.data.reading.bag.storage.files import BagFiles
from slipid.support.errors import DataError, bad_data

_REMEDY = {
    "rosbag1": "run: rosbag reindex {file}",
    "sqlite3": "save what is left with: sqlite3 {file} .recover | sqlite3 whole.db3",
    "mcap": "save what is left with: mcap recover {file} -o whole.mcap",
}
_METADATA = "copy the folder again, or run: ros2 bag reindex {file}"


def damaged(files: BagFiles, error: Exception) -> DataError:
    """The error about a bag that rosbags cannot read."""
    said = (str(error).splitlines() or [type(error).__name__])[0][:200]
    file = files.parts[0]
    if "not indexed" in said:
        expected = f"a whole bag; {_REMEDY['rosbag1'].format(file=file)}"
        return bad_data(files.path, "the bag has no index: its recording was cut off", expected)
    if isinstance(error, PermissionError):
        return bad_data(files.path, f"cannot be read ({error.strerror})", "a readable bag")
    if isinstance(error, KeyError) and error.args[0] in ("protobuf", "jsonschema", "flatbuffer"):
        found = f"it holds messages encoded as {error.args[0]}, which are not read"
        expected = "ROS messages only; filter them out with: mcap filter"
        return bad_data(files.path, found, expected)
    if "Profile is not ros2" in said:
        expected = "one that ROS 2 recorded (profile ros2); write it again with: ros2 bag convert"
        return bad_data(files.path, "an MCAP file of another profile", expected)
    remedy = _REMEDY[files.storage].format(file=file)
    if "metadata" in said.lower() or "files are missing" in said:
        remedy = _METADATA.format(file=files.path)
    found = f"the bag is damaged or was cut off ({said})"
    return bad_data(files.path, found, f"a whole one; {remedy}")
