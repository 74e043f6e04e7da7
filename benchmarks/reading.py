"""Which cyclers' files are read right. Run: python benchmarks/reading.py [--json].

One simulated pulse test is written in every layout of `layouts.LAYOUTS`, in several variants (`cycler_files.VARIANTS`). Each row says
whether it was read right (time, current, voltage and temperature are those of the simulation, within the digits that are written),
refused with the right cause, or wrong: refused for another cause, or read with other numbers.
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from cycler_files import VARIANTS, pulse_test, write

from chargetune.battery.identification.cycler_files import read_record
from chargetune.battery.identification.layouts import LAYOUTS

# Where a file may be refused: variant and what the message then says.
CAUSES = {"bare decimal comma": ("decimal commas need semicolons", "decimal mark"), "restarting clock": ("the clock counts each step",)}
# Times are written with at least three digits of a second, two where the clock has no more; hours with eight digits.
TIME_S, CURRENT_A, VOLTAGE_V, TEMPERATURE_K = 2e-2, 1e-5, 2e-5, 0.06


def verdict(path, layout, variant, test):
    """("right" | "refused" | "wrong", what was said or differs)."""
    try:
        record = read_record(path)
    except ValueError as error:
        right = any(cause in str(error) for cause in CAUSES.get(variant, ()))
        return "refused" if right else "wrong", str(error)
    if len(record) != len(test.time):
        return "wrong", f"{len(record)} samples of {len(test.time)}"
    differences = {
        "time_s": (record.time_s - record.time_s[0] - (test.time - test.time[0]), TIME_S),
        "current_A": (record.current_A - test.current, CURRENT_A),
        "voltage_V": (record.voltage_V - test.voltage, VOLTAGE_V),
    }
    if layout.temperature:
        if record.temperature_K is None:
            return "wrong", "; ".join(("no temperature", *record.remarks))
        differences["temperature_K"] = (record.temperature_K - 273.15 - test.celsius, TEMPERATURE_K)
    off = {name: float(np.max(np.abs(values))) for name, (values, allowed) in differences.items() if np.max(np.abs(values)) > allowed}
    return (
        ("wrong", ", ".join(f"{name} off by {value:.4g}" for name, value in off.items())) if off else ("right", "; ".join(record.remarks))
    )


def results(layouts=LAYOUTS, variants=VARIANTS):
    """One row for each layout and variant."""
    test, found = pulse_test(), []
    with tempfile.TemporaryDirectory() as folder:
        for layout in layouts:
            for variant in variants:
                said, why = verdict(write(Path(folder), layout, variant, test), layout, variant, test)
                found.append({"layout": layout.name, "variant": variant, "verdict": said, "said": why})
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true")
    found = results()
    counts = {said: sum(row["verdict"] == said for row in found) for said in ("right", "refused", "wrong")}
    if parser.parse_args().json:
        print(json.dumps({"rows": found, "counts": counts}))
        return
    for row in found:
        if row["verdict"] != "right":
            print(f"{row['layout']:28} {row['variant']:22} {row['verdict']:8} {row['said'][:160]}")
    print(f"{len(found)} files: " + ", ".join(f"{count} {said}" for said, count in counts.items()))


if __name__ == "__main__":
    main()
