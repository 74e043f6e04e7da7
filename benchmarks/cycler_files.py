"""One simulated pulse test, written as the file of any cycler: what `reading.py` and the tests of the reader read."""

import zipfile
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

from chargetune.battery.identification.layouts import Layout

__all__ = ["VARIANTS", "PulseTest", "pulse_test", "write"]

# Capacity Ah, R0 and R1 ohm, tau1 s.
CAPACITY, R0, R1, TAU = 3.0, 0.030, 0.020, 30.0
# Current A, length s, logging interval s of one set and the move to the next SOC.
STEPS = ((0.0, 1800.0, 60.0), (-3.0, 30.0, 1.0), (0.0, 40.0, 2.0), (2.25, 10.0, 1.0), (0.0, 40.0, 2.0), (-3.0, 337.5, 30.0))
SETS = 3
# It goes on over midnight.
BEGIN = datetime(2024, 5, 6, 22, 0, 0)  # noqa: DTZ001 (cyclers write local time)
VARIANTS = (
    "as exported",
    "decimal comma",
    "bare decimal comma",
    "other locale's dates",
    "restarting clock",
    "duplicated last row",
    "discharge positive",
    "UTF-16",
)
DATES = {"as exported": "%Y-%m-%d %H:%M:%S", "other locale's dates": "%d.%m.%Y %H:%M:%S"}


@dataclass(frozen=True)
class PulseTest:
    """Time in s, time in the step, current in A (positive charges), voltage in V, degree Celsius, number of the step; each (n,)."""

    time: np.ndarray
    in_step: np.ndarray
    current: np.ndarray
    voltage: np.ndarray
    celsius: np.ndarray
    step: np.ndarray


def ocv(soc):
    return 3.35 + 0.75 * soc + 0.1 * soc**3


def pulse_test():
    """A full cell, three sets of pulses and a rest: the exact response of the circuit, rounded as cyclers do."""
    rows, now, soc, slow = [], 0.0, 1.0, 0.0
    for number, (current, length, interval) in enumerate([*(STEPS * SETS), STEPS[0]], start=1):
        ends = [*np.arange(interval, length - 1e-9, interval), length]
        for end, start in zip(ends, [0.0, *ends[:-1]], strict=True):
            decay = np.exp(-(end - start) / TAU)
            slow, soc = slow * decay + R1 * current * (1 - decay), soc + current * (end - start) / 3600 / CAPACITY
            rows.append((now + end, end, current, ocv(soc) + R0 * current + slow, 25.0, number))
        now += length
    table = np.array(rows)
    return PulseTest(table[:, 0], table[:, 1], table[:, 2], np.round(table[:, 3], 5), table[:, 4], table[:, 5].astype(int))


def scale(heading):
    """What one SI unit is in the unit of a heading, read from the heading alone."""
    letters = heading.lower()
    if any(milli in letters for milli in ("ma)", "/ma", "_ma", "mv)", "_mv", "_ms")):
        return 1000.0
    return 1 / 3600 if any(hours in letters for hours in ("(h)", "[h]")) else 1.0


def clock(seconds):
    return f"{int(seconds // 3600):02d}:{int(seconds % 3600 // 60):02d}:{seconds % 60:06.3f}"


def time_cell(layout, seconds, variant):
    match layout.clock:
        case "clock":
            return clock(seconds)
        case "step":
            return f"{int(seconds // 3600)}:{int(seconds % 3600 // 60):02d}:{seconds % 60:06.3f}"
        case "days":
            return f"  {int(seconds // 86400)}d {clock(seconds % 86400)[:-1]}"
        case "date":
            form = "%d.%m.%Y %H:%M:%S.%f" if variant == "other locale's dates" else "%m/%d/%Y %H:%M:%S.%f"
            return (BEGIN + timedelta(seconds=seconds)).strftime(form)
    return f"{seconds * scale(layout.time):.8f}" if scale(layout.time) < 1 else f"{seconds * scale(layout.time):.3f}"


def rows(layout: Layout, test: PulseTest, variant: str):
    """The rows of cells below the headings, without the sums of a nested layout."""
    restarts = variant == "restarting clock" or layout.clock == "step"
    sign = -1.0 if variant == "discharge positive" else 1.0
    if variant in {"decimal comma", "bare decimal comma"}:

        def number(text):
            return text.replace(".", ",")
    else:

        def number(text):
            return text

    for k, (t, within, i, v, c, step) in enumerate(
        zip(test.time, test.in_step, test.current, test.voltage, test.celsius, test.step, strict=True), start=1
    ):
        stamp = BEGIN + timedelta(seconds=float(t))
        seconds = float(within if restarts and layout.clock != "date" else t)
        shown = time_cell(layout, seconds, variant)
        flow = sign * i if layout.signed else abs(i)
        of = {
            layout.time: shown if ":" in shown else number(shown),
            layout.current: number(f"{flow * scale(layout.current):.5f}"),
            layout.voltage: number(f"{v * scale(layout.voltage):.5f}"),
            layout.temperature: number(f"{c:.1f}"),
            layout.step: str(step),
            layout.state: layout.states[0 if i == 0 else 1 if i > 0 else 2],
            "Ewe/V": number(f"{v + 0.08:.5f}"),
            "Ece/V": number("0.08000"),
            "Current_charge": number("0.00000"),
            "Voltage_charge": number("0.00000"),
            **dict.fromkeys(("Date", "Date Time", "Date_Time"), stamp.strftime(DATES.get(variant, DATES["as exported"]))),
        }
        of[layout.voltage] = number(f"{v * scale(layout.voltage):.5f}")
        yield [of.get(heading, str(k)) for heading in layout.headings], int(step), i, within


def write(folder: Path, layout: Layout, variant: str, test: PulseTest) -> Path:
    """The file of one layout and variant in a folder."""
    path = folder / f"{layout.name} {variant}{layout.suffix}".replace(" ", "_").replace(",", "")
    if "comma" in variant:
        layout = replace(layout, separator=";" if layout.separator == "," and variant == "decimal comma" else layout.separator)
    lead = 2 if layout.nested else 0
    table = [[*[""] * lead, *layout.headings]]
    if layout.nested:
        table = [["Cycle Index", "Chg. Cap.(Ah)"], ["", "Step Index", "Step Type", "Step Time", "Capacity(Ah)"], *table, ["1", "0.1"]]
    if layout.units:
        units = dict(zip((layout.current, layout.voltage, layout.temperature), layout.units, strict=True))
        table.append([units.get(heading, "") for heading in layout.headings])
    before = 0
    for cells, step, current, _ in rows(layout, test, variant):
        if layout.nested and step != before:
            table.append(["", str(step), "CC DChg" if current < 0 else "Rest", "00:00:30", "0.02500"])
        before = step
        table.append([*[""] * lead, *cells])
    if variant == "duplicated last row":
        table.append(table[-1])
    if layout.suffix.endswith("xlsx"):
        workbook(path, table)
    elif layout.suffix.endswith("parquet"):
        parquet(path, table)
    else:
        # Cyclers quote nothing, which is why bare decimal commas are a trap.
        text = "".join(line + "\n" for line in (*layout.before, *(layout.separator.join(row) for row in table)))
        path.write_bytes(text.encode("utf-16" if variant == "UTF-16" else "utf-8"))
    return path


def parquet(path, table):
    import pyarrow as pa
    from pyarrow import parquet as pq

    def column(values):
        try:
            return pa.array([float(value) for value in values])
        except ValueError:
            return pa.array(values)

    heads, *below = table
    pq.write_table(pa.table({head: column([row[k] for row in below]) for k, head in enumerate(heads)}), path)


def workbook(path, table):
    """A workbook of one sheet, numbers as numbers, dates as Excel's days since 1900, everything else as text."""
    sheet = ["<sheetData>"]
    for row in table:
        sheet.append("<row>")
        for cell in row:
            try:
                sheet.append(f"<c><v>{float(cell)!r}</v></c>")
                continue
            except ValueError:
                pass
            try:
                day = datetime.strptime(cell, DATES["as exported"]) - datetime(1899, 12, 30)  # noqa: DTZ001, DTZ007
                sheet.append(f'<c s="1"><v>{day.total_seconds() / 86400!r}</v></c>')
            except ValueError:
                sheet.append(f'<c t="inlineStr"><is><t>{escape(cell)}</t></is></c>')
        sheet.append("</row>")
    sheet.append("</sheetData>")
    main = 'xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"'
    office = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    types = "http://schemas.openxmlformats.org/package/2006/content-types"
    package = "http://schemas.openxmlformats.org/package/2006/relationships"
    kind = "application/vnd.openxmlformats-officedocument.spreadsheetml"
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{types}"><Default Extension="rels" '
        'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        f'<Override PartName="/xl/workbook.xml" ContentType="{kind}.sheet.main+xml"/>'
        f'<Override PartName="/xl/styles.xml" ContentType="{kind}.styles+xml"/>'
        f'<Override PartName="/xl/worksheets/sheet1.xml" ContentType="{kind}.worksheet+xml"/></Types>',
        "_rels/.rels": f'<Relationships xmlns="{package}"><Relationship Id="r1" Type="{office}/officeDocument" '
        'Target="xl/workbook.xml"/></Relationships>',
        "xl/workbook.xml": f'<workbook {main} xmlns:r="{office}"><sheets><sheet name="record" sheetId="1" r:id="r1"/></sheets></workbook>',
        "xl/_rels/workbook.xml.rels": f'<Relationships xmlns="{package}"><Relationship Id="r1" Type="{office}/worksheet" '
        f'Target="worksheets/sheet1.xml"/><Relationship Id="r2" Type="{office}/styles" Target="styles.xml"/></Relationships>',
        "xl/styles.xml": f'<styleSheet {main}><cellXfs count="2"><xf numFmtId="0"/>'
        '<xf numFmtId="22" applyNumberFormat="1"/></cellXfs></styleSheet>',
        "xl/worksheets/sheet1.xml": f"<worksheet {main}>{''.join(sheet)}</worksheet>",
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, f'<?xml version="1.0" encoding="UTF-8"?>{content}')
