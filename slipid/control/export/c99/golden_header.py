"""Steps that the generated code must repeat, as a header of C."""

from __future__ import annotations

import numpy as np

from slipid.control.export.c99.code import Code
from slipid.control.export.c99.lowering.text import wrapped
from slipid.control.export.fields import Struct
from slipid.control.export.golden import golden


def golden_header(code: Code) -> str:
    """Text of golden.h: the steps as tables, and how structs are filled and read."""
    kept = golden(code.pilot)
    names = [f.name for f in code.estimate.fields for _ in range(f.size)]
    scale = np.maximum(np.abs(kept.said).max(axis=0), 1e-3)
    rows = [
        "#include <math.h>",
        "",
        f"#define GOLDEN_STEPS {len(kept.given)}",
        f"#define GOLDEN_GIVEN {kept.given.shape[1]}",
        f"#define GOLDEN_SAID {kept.said.shape[1]}",
        "",
        *_table("golden_given[GOLDEN_STEPS][GOLDEN_GIVEN]", kept.given),
        *_table("golden_said[GOLDEN_STEPS][GOLDEN_SAID]", kept.said),
        *_table("golden_command[GOLDEN_STEPS][SLIPID_WHEELS]", kept.command),
        *_table("golden_scale[GOLDEN_SAID]", scale),
        "static const char *const golden_names[GOLDEN_SAID] = {",
        *wrapped((f'"{name}"' for name in names), "  "),
        "};",
        "",
        *_filling(code.reading),
        *_reading_out(code.estimate),
    ]
    return "\n".join(rows) + "\n"


def _table(declared: str, values: np.ndarray) -> list[str]:
    def word(value: float) -> str:
        return "NAN" if np.isnan(value) else repr(float(value))

    if values.ndim == 1:
        lines = wrapped(map(word, values), "  ")
    else:
        lines = [x for row in values for x in ("  {", *wrapped(map(word, row), "    "), "  },")]
    return [f"static const double {declared} = {{", *lines, "};", ""]


def _filling(struct: Struct) -> list[str]:
    lines = [f"static void golden_reading({struct.name} *reading, const double *row) {{"]
    place = 0
    for field in struct.fields:
        for k in range(field.size):
            at = f"[{k}]" if field.shape else ""
            lines.append(f"  reading->{field.name}{at} = (slipid_real)row[{place}];")
            place += 1
    return [*lines, "}", ""]


def _reading_out(struct: Struct) -> list[str]:
    lines = [f"static void golden_said_of(const {struct.name} *estimate, double *out) {{"]
    place = 0
    for field in struct.fields:
        if field.size:
            index = "[k]" if field.shape else ""
            value = f"(double)estimate->{field.name}{index}"
            if field.kind == "bool":
                value = f"estimate->{field.name}{index} ? 1.0 : 0.0"
            lines.append(
                f"  for (int k = 0; k < {field.size}; ++k) out[{place} + k] = {value};"
                if field.shape
                else f"  out[{place}] = {value};"
            )
        place += field.size
    return [*lines, "}", ""]
