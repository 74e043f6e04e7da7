"""The layouts of cycler files as data: the headings of each, and the vocabulary of names and units that every heading is read with.

A file need not be of a known layout: its columns are found by `NAMES` and `UNITS`. `LAYOUTS` is what the page of the
documentation, the tests and the benchmark are made from. Headings are those that the cyclers' programs write, as their
manuals and public files show them.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CLOCKS", "LAYOUTS", "NAMES", "NEEDED", "SHORT_UNITS", "UNITS", "Layout"]

NEEDED = ("time", "current", "voltage")


@dataclass(frozen=True)
class Layout:
    """One kind of file: its headings by quantity, what stands before them, its separator, and what its clock and current are.

    ``clock`` is "seconds" (a number in the heading's unit), "clock" (h:mm:ss), "days" (0d 00:00:00), "step" (the time in the
    step) or "date". ``signed`` is false where a column of states has the sign of the current. ``units`` is a row of units
    below the headings, ``nested`` puts two further rows of headings above and a row of sums before each step.
    """

    name: str
    time: str
    current: str
    voltage: str
    temperature: str = ""
    step: str = ""
    state: str = ""
    states: tuple[str, str, str] = ("Rest", "Charge", "Discharge")
    before: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    units: tuple[str, str, str] | None = None
    separator: str = ","
    suffix: str = ".csv"
    clock: str = "seconds"
    signed: bool = True
    nested: bool = False

    @property
    def headings(self) -> tuple[str, ...]:
        """Every heading in the order in which `identify`'s test files have them."""
        given = (self.time, self.step, self.state, *self.others, self.current, self.voltage, self.temperature)
        return tuple(heading for heading in given if heading)


LAYOUTS: tuple[Layout, ...] = (
    Layout(
        "Arbin", "Test_Time(s)", "Current(A)", "Voltage(V)", "Aux_Temperature_1(C)", "Step_Index", others=("Data_Point", "Cycle_Index")
    ),
    Layout(
        "Arbin, newer", "Test Time (s)", "Current (A)", "Voltage (V)", "Temperature (C)_1", "Step Index", others=("Date Time",
        "Cycle Index")
    ),
    Layout(
        "Neware, general", "Total Time", "Current(mA)", "Voltage(V)", "T1(℃)", "Step Index", "Step Type", ("Rest", "CC Chg", "CC DChg"),
        others=("DataPoint",), clock="clock",
    ),
    Layout(
        "Neware, steps", "Relative Time(h:min:s.ms)", "Cur(mA)", "Voltage(V)", step="Step", state="Status",
        states=("Rest", "CC_Chg", "CC_DChg"), clock="step",
    ),
    Layout("Neware, nested", "Total Time", "Current(A)", "Voltage(V)", others=("DataPoint", "Date"), clock="clock", nested=True),
    Layout(
        "BioLogic", "time/s", "<I>/mA", "Ecell/V", "Temperature/°C", "Ns", others=("mode",), separator="\t", suffix=".mpt",
        before=("EC-Lab ASCII FILE", "Nb header lines : 4", ""),
    ),
    Layout(
        "BioLogic, three electrodes", "time/s", "I/mA", "Ewe-Ece/V", step="Ns", others=("mode", "Ewe/V", "Ece/V"), separator="\t",
        suffix=".mpt", before=("EC-Lab ASCII FILE", "Nb header lines : 4", ""),
    ),
    Layout(
        "BioLogic, dates", "time/s", "I/mA", "Ewe/V", step="Ns", others=("mode",), separator="\t", suffix=".mpt", clock="date",
        before=("EC-Lab ASCII FILE", "Nb header lines : 4", ""),
    ),
    Layout(
        "Maccor, text", "TestTime", "Amps", "Volts", "Temp 1", "Step", "State", ("R", "C", "D"), others=("Rec#", "Cyc#"), separator="\t",
        suffix=".txt", clock="days", signed=False, before=("Today's Date:\t06 May 2024\tDate of Test:\t06 May 2024",
        "Procedure:\tmade.000"),
    ),
    Layout(
        "Maccor, CSV", "Test Time (Sec)", "Current (A)", "Voltage (V)", step="Step", state="MD", states=("R", "C", "D"),
        others=("Rec", "Cycle P"), signed=False,
    ),
    Layout(
        "Bitrode", "Total Time", "Current (A)", "Voltage (V)", "Temperature A1", "Step", "Mode", ("REST", "CHRG", "DCHG"),
        others=("Cycle", "Loop Counter #1"), clock="clock",
    ),
    Layout(
        "Digatron", "Prog Time", "Current", "Voltage", "Temperature", "Step", "Status", ("PAU", "CHA", "DCH"), others=("Cycle",
        "Procedure"),
        units=("[A]", "[V]", "[C]"), clock="clock", before=("", "", "Measurement ID,1", "Nominal Capacity, 3", ""),
    ),
    Layout(
        "Basytec", "~Time[h]", "I[A]", "U[V]", "T1[°C]", "Line", "Command", ("Pause", "Charge", "Discharge"), others=("DataSet",),
        separator="\t", suffix=".txt", before=("~Resultfile from Basytec Battery Test System", "~Battery: made", "~"),
    ),
    Layout(
        "Novonix", "Run Time (h)", "Current (A)", "Potential (V)", "Temperature (°C)", "Step Number", others=("Cycle Number", "Step Type"),
        before=("[Summary]", "Novonix UHPC data file", "[End Summary]", "[Protocol]", "[End Protocol]", "[Data]"),
    ),
    Layout(
        "PEC", "Total Time (Seconds)", "Current (mA)", "Voltage (mV)", step="Step", others=("Test", "Cycle"),
        before=("TestRegime Name:,made", "Cell:,1", ""),
    ),
    Layout(
        "Landt", "TestTime/Sec.", "Current/mA", "Voltage/V", step="Step-Index", others=("Record", "Cycle-Index"), separator="\t",
        suffix=".txt",
    ),
    Layout("BDF, labels", "Test Time / s", "Current / A", "Voltage / V", "Surface Temperature T1 / degC", "Step Index / 1",
    suffix=".bdf.csv"),
    Layout("BDF, names", "test_time_second", "current_ampere", "voltage_volt", "surface_temperature_t1_celsius", suffix=".bdf.csv"),
    Layout("BDF, Parquet", "Test Time / s", "Current / A", "Voltage / V", "Ambient Temperature / degC", suffix=".bdf.parquet"),
    Layout("XLSX, Arbin", "Test_Time(s)", "Current(A)", "Voltage(V)", step="Step_Index", others=("Date_Time",), suffix=".xlsx"),
    Layout(
        "XLSX, Neware", "Total Time", "Current(A)", "Voltage(V)", step="Step Index", state="Step Type", states=("Rest", "CC Chg",
        "CC DChg"),
        others=("DataPoint",), clock="clock", suffix=".xlsx",
    ),
    Layout("Underscores", "Time_s", "Current_A", "Voltage_V", "Temperature_degC"),
    Layout("Milli", "time_ms", "current_mA", "voltage_mV", separator=";"),
    Layout("Measured", "Time", "Current_measured", "Voltage_measured", "Temperature_measured", others=("Current_charge", "Voltage_charge")),
)  # fmt: skip

# Names by quantity without spaces, signs and unit, the first one in a file is taken. Chinese and German programs write their own.
NAMES: dict[str, tuple[str, ...]] = {
    "time": (
        "testtime", "totaltime", "progtime", "runtime", "elapsedtime", "cumulativetime", "experimenttime", "timesincestart", "recordtime",
        "time", "t", "unixtime", "epochtime", "epoch", "totalzeit", "zeit", "总时间", "测试时间",
    ),
    "step": ("stepindex", "stepid", "stepnumber", "stepno", "step", "ns", "line", "stepcount", "stepindex1", "工步号", "工步序号"),
    "step_time": ("steptime", "relativetime", "tstep", "stepduration", "相对时间", "时间"),
    "date": (
        "datetime", "dateandtime", "dpttime", "absolutetime", "realtime", "systime", "systemtime", "timestamp", "date", "datum", "绝对时间",
        "系统时间",
    ),
    "current": (
        "cellcurrent", "batterycurrent", "current", "cur", "i", "amps", "amp", "ampere", "amperes", "ibat", "ibatt",
        "icell", "strom", "电流",
    ),
    "voltage": (
        "eweece", "ecell", "cellvoltage", "vcell", "ucell", "terminalvoltage", "batteryvoltage", "voltage", "volts", "volt", "vol",
        "cellpotential", "potential", "ubat", "ubatt", "vbat", "vbatt", "u", "v", "e", "ewe", "spannung", "电压",
    ),
    # Two columns, one for either way, where there is none for both.
    "charging": ("chargecurrent", "chargingcurrent", "currentcharge", "currentcharging", "chgcurrent", "ichg", "icharge", "ladestrom"),
    "discharging": (
        "dischargecurrent", "dischargingcurrent", "currentdischarge", "currentdischarging", "dchgcurrent", "dischgcurrent", "idchg", "idis",
        "idischarge", "entladestrom",
    ),
    "counter": ("ece",),
    "temperature": (
        "celltemperature", "tcell", "surfacetemperature", "surfacetemperaturet1", "temperature", "temp", "temperaturet1", "auxtemperature1",
        "auxtemp1", "temperature1", "temp1", "temperaturea1", "auxt1", "t1", "tc1", "t", "temperatur", "温度", "chambertemperature",
        "environmenttemperature", "ambienttemperature",
    ),
    "state": ("state", "status", "md", "steptype", "stepname", "command", "mode", "stepmode", "stepstate", "workmode",
        "zustand", "状态", "工步类型"),
}  # fmt: skip

# Factors to SI by quantity; "" is a heading without a unit. Clocks (h:mm:ss) are in seconds whatever their heading says.
UNITS: dict[str, dict[str, float]] = {
    "time": {
        "": 1.0, **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0), **dict.fromkeys(("ms", "msec", "millisecond"), 1e-3),
        **dict.fromkeys(("min", "mins", "minute", "minutes"), 60.0), **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), 3600.0),
        **dict.fromkeys(("d", "day", "days"), 86400.0), "us": 1e-6, "microsecond": 1e-6,
    },
    "current": {
        "": 1.0, **dict.fromkeys(("a", "amp", "amps", "ampere", "amperes"), 1.0), **dict.fromkeys(("ma", "milliamp", "milliampere"), 1e-3),
        "ua": 1e-6, "microampere": 1e-6, "ka": 1e3,
    },
    "voltage": {"": 1.0, **dict.fromkeys(("v", "volt", "volts"), 1.0), "mv": 1e-3, "millivolt": 1e-3, "uv": 1e-6, "microvolt": 1e-6},
    "temperature": {"": 1.0, **dict.fromkeys(("c", "degc", "celsius", "degreec", "oc"), 1.0), "k": 1.0, "kelvin": 1.0, "f": 1.0,
    "degf": 1.0},
}  # fmt: skip
# The shortest name of each unit, as a person types it.
SHORT_UNITS = {"time": ("s", "ms", "us", "min", "h", "d"), "current": ("A", "mA", "uA", "kA")}
# Clocks that can be read in two ways.
CLOCKS = ("hh:mm", "mm:ss", "d:hh:mm:ss", "hh:mm:ss:ms")
UNITS["step_time"], UNITS["counter"] = UNITS["time"], UNITS["voltage"]
UNITS["charging"] = UNITS["discharging"] = UNITS["current"]
