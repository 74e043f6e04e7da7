"""The commands of ``chargetune``. Everything heavy is imported inside a command, so that ``--help`` is instant."""

from __future__ import annotations

import sys
import traceback
from enum import StrEnum
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from chargetune import __version__
from chargetune.battery.identification.layouts import CLOCKS, SHORT_UNITS
from chargetune.cli.terminal import any_terminal
from chargetune.runtime.interrupts import INTERRUPTED, Watch, handled_interrupts

__all__ = ["app", "main"]

app = typer.Typer(
    name="chargetune",
    help="Tune a model predictive charging controller in closed loop: fast, and within the limits.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
store_app = typer.Typer(name="store", help="Check, salvage, export or migrate a store.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(store_app)
# EX_SOFTWARE of sysexits.h.
DEFECT = 70


class ExportFormat(StrEnum):
    """What `store export` writes."""

    PARQUET = "parquet"
    CSV = "csv"


class FileKind(StrEnum):
    """The files that a person writes."""

    STUDY = "study"
    CELL = "cell"
    CAMPAIGN = "campaign"


class CaseName(StrEnum):
    """The case studies."""

    BACKOFF = "backoff"
    MODEL = "model"
    BOTH = "both"
    RBF = "rbf"


class TunerChoice(StrEnum):
    """The tuners."""

    DEFAULT = "default"
    EI = "ei"
    SOBOL = "sobol"
    TWIN = "twin"
    ITERATIVE_LEARNING = "iterative_learning"
    COMPOSITE = "composite"


ConfigFile = Annotated[Path, typer.Argument(help="Study file (TOML).", show_default=False)]
StoreArgument = Annotated[str, typer.Argument(help="Store: a file, or postgresql://user@host/database.", show_default=False)]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for a program instead of text for a person.")]


class Branch(StrEnum):
    """Which rests of a cell with hysteresis the OCV is."""

    CHARGE = "charge"
    DISCHARGE = "discharge"
    MIDDLE = "middle"


class Sign(StrEnum):
    """What a positive current of a cycler's file does."""

    CHARGE = "charge"
    DISCHARGE = "discharge"
    UNSIGNED = "unsigned"


Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files of the same kind that exist.")]
Workers = Annotated[int, typer.Option(min=1, help="Worker processes.")]


@app.command()
def init(
    path: Annotated[Path, typer.Argument(help="Study file to write.")] = Path("study.toml"),
    cell: Annotated[Path | None, typer.Option(help="Cell file, as `identify` writes it.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a commented study file that runs."""
    from chargetune.cli.init import init_command

    init_command(path, cell=cell, overwrite=overwrite)


@app.command()
def schema(kind: Annotated[FileKind, typer.Argument(help="Kind of file.")] = FileKind.STUDY) -> None:
    """Print the JSON schema of a file, by which an editor completes and checks it: every key with unit, default and range."""
    from chargetune.cli.schema import schema_command

    schema_command(kind.value)


@app.command()
def tune(
    config: ConfigFile,
    trials: Annotated[int | None, typer.Option(min=1, help="Trials in all; the file's number by default.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the study; the file's by default.")] = None,
    store: Annotated[
        str | None, typer.Option(help="Where trials are kept, a file or postgresql://...; by default OUT/study.sqlite or CONFIG's name.")
    ] = None,
    workers: Annotated[
        int,
        typer.Option(
            min=1,
            help="Worker processes: for the batches of the file, else a trial each; of the tuner 'range' with a [plant] a plant each.",
        ),
    ] = 1,
    out: Annotated[Path | None, typer.Option(help="Folder for figures and the summary.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Tune although the check of the formulation finds an error.")] = False,
    accept_changed: Annotated[bool, typer.Option("--accept-changed", help="Resume although the study file has changed.")] = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Tune theta on the plant of a study file. The same command again resumes."""
    _read_first(config, "study")
    from chargetune.cli.tune import tune_command

    tune_command(
        config,
        trials=trials,
        seed=seed,
        store=store,
        workers=workers,
        out=out,
        force=force,
        accept_changed=accept_changed,
        overwrite=overwrite,
        as_json=as_json,
    )


@app.command()
def campaign(
    file: Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="Campaign file (TOML): study files and seeds.", show_default=False)],
    store: Annotated[
        str | None, typer.Option(help="Where all trials are kept, a file or postgresql://...; by default CAMPAIGN's name.")
    ] = None,
    workers: Workers = 2,
    force: Annotated[bool, typer.Option("--force", help="Tune although the check of a formulation finds an error.")] = False,
    as_json: AsJson = False,
) -> None:
    """Tune many study files with many seeds. The same command again resumes."""
    _read_first(file, "campaign")
    from chargetune.cli.campaign import campaign_command

    campaign_command(file, store=store, workers=workers, force=force, as_json=as_json)


@app.command()
def check(
    config: ConfigFile,
    safe: Annotated[str | None, typer.Option(help="A theta declared safe, as for simulate --theta; it has to keep every limit.")] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder for a figure of each finding.")] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Find errors of a formulation before anything is tuned; exit code 1 when there are any."""
    _read_first(config, "study")
    from chargetune.cli.check import check_command

    check_command(config, safe=safe, figures=figures, overwrite=overwrite, as_json=as_json)


@app.command()
def simulate(
    config: ConfigFile,
    theta: Annotated[
        str | None, typer.Option(help='Values: "0.1,0.1,..." or JSON by name: \'{"backoff_V": [...]}\'. The file\'s by default.')
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of noise and disturbances.")] = 0,
    figure: Annotated[Path | None, typer.Option(help="Figure of the run to write (png, pdf, svg).")] = None,
    out: Annotated[Path | None, typer.Option(help="Trace of the run to write (CSV), one row an interval.")] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Run one closed loop of a study file at one theta."""
    _read_first(config, "study")
    from chargetune.cli.simulate import simulate_command

    simulate_command(config, theta=theta, seed=seed, figure=figure, out=out, overwrite=overwrite, as_json=as_json)


@app.command()
def show(
    store: StoreArgument,
    study: Annotated[str | None, typer.Option(help="Name of a study; by default all are listed.")] = None,
    worth: Annotated[bool, typer.Option("--worth", help="What each entry of theta is worth over the range of use of that study.")] = False,
    as_json: AsJson = False,
) -> None:
    """List the studies of a store, or the trials of one."""
    from chargetune.cli.show import show_command
    from chargetune.cli.worth import show_worth

    if worth:
        show_worth(store, study=study, as_json=as_json)
    else:
        show_command(store, study=study, as_json=as_json)


@app.command()
def report(
    store: StoreArgument,
    study: Annotated[str | None, typer.Option(help="Name of a study; may be left out where there is one.")] = None,
    out: Annotated[Path | None, typer.Option("--output", "-o", help="Page to write; by default STORE's name with .html.")] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder for the figures as vector PDF, at the width of a journal.")] = None,
    evaluate: Annotated[
        bool, typer.Option(help="Evaluate the best theta and its neighbours on a simulated plant, for the sensitivities.")
    ] = True,
    certificate: Annotated[
        Path | None, typer.Option(help="Certificate of the study; by default the one beside the store, where it is of this study.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Write one study as a self-contained HTML page, which opens offline."""
    from chargetune.cli.report import report_command

    report_command(
        store, study=study, out=out, figures=figures, evaluate=evaluate, certificate=certificate, overwrite=overwrite, as_json=as_json
    )


@app.command()
def web(
    store: StoreArgument,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes a free one.")] = 8000,
    host: Annotated[str, typer.Option(help="Address to listen on; any but loopback needs a token.")] = "127.0.0.1",
    token: Annotated[str | None, typer.Option(envvar="CHARGETUNE_WEB_TOKEN", help="What a viewer must know.", show_default=False)] = None,
) -> None:
    """Show the studies of a store live in a browser, read-only."""
    from chargetune.cli.web import web_command

    web_command(store, port=port, host=host, token=token)


@app.command()
def reproduce(
    case: Annotated[
        CaseName, typer.Argument(help="What theta is: the backoff, the model's R1, both, or the stage cost (rbf).", show_default=False)
    ],
    seeds: Annotated[str, typer.Option(help="Mismatch seeds A:B (B not included), or a list A,B,C.")] = "0:20",
    trials: Annotated[int, typer.Option(min=1, help="Trials of each seed.")] = 60,
    tuner: Annotated[
        TunerChoice, typer.Option(help="The constrained default, the paper's EI on G, Sobol points, the twin, or iterative learning.")
    ] = TunerChoice.DEFAULT,
    workers: Workers = 2,
    out: Annotated[Path, typer.Option(help="Folder for stores, claims.json and figures; studies found there go on.")] = Path(
        "out/reproduce"
    ),
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Repeat a study of Hirt et al. (ADCHEM 2024, rbf: arXiv 2410.04982) over mismatch seeds and decide its claims."""
    from chargetune.cli.reproduce import reproduce_command

    reproduce_command(
        case.value, seeds=seeds, trials=trials, tuner=tuner.value, workers=workers, out=out, overwrite=overwrite, as_json=as_json
    )


@app.command()
def identify(
    data: Annotated[Path, typer.Argument(help="Measured pulses (a cycler's CSV, text, Excel or Parquet).", show_default=False)],
    out: Annotated[
        Path, typer.Option("--output", "-o", help="Cell file to write; of several temperatures one each, cell_25degC.toml.")
    ] = Path("cell.toml"),
    rc: Annotated[int, typer.Option(min=1, max=2, help="R-C pairs of the circuit.")] = 1,
    capacity: Annotated[
        float | None,
        typer.Option("--capacity-Ah", help="Capacity of one cell; by default the charge between the record's fullest and emptiest point."),
    ] = None,
    ocv: Annotated[
        Path | None, typer.Option(help="A slow charge and discharge (CSV) to take the OCV from; surer near full and empty.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the cell; the file's by default.")] = None,
    series: Annotated[int, typer.Option(min=1, help="Cells in series, where the files are of a pack; the cell file is of one cell.")] = 1,
    parallel: Annotated[int, typer.Option(min=1, help="Cells in parallel, where the files are of a pack.")] = 1,
    figure: Annotated[Path | None, typer.Option(help="Figure of the fit to write (png, pdf, svg).")] = None,
    check: Annotated[list[Path] | None, typer.Option(help="A discharge (CSV) to predict with the cell; may be given again.")] = None,
    temperature: Annotated[float | None, typer.Option("--temperature", help="Only the pulses at this temperature, degree Celsius.")] = None,
    branch: Annotated[
        Branch, typer.Option(help="The OCV after charge, after discharge or in the middle, where the cell has hysteresis.")
    ] = Branch.MIDDLE,
    sign: Annotated[
        Sign | None,
        typer.Option(help="What a positive current does; unsigned: the voltage tells of each stretch.", show_default="from the file"),
    ] = None,
    time_unit: Annotated[
        str | None, typer.Option("--time-unit", help=f"{', '.join((*SHORT_UNITS['time'], *CLOCKS))}.", show_default="from the heading")
    ] = None,
    current_unit: Annotated[
        str | None, typer.Option("--current-unit", help=f"{', '.join(SHORT_UNITS['current'])}.", show_default="from the heading")
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Fit a cell's circuit to measured pulses: OCV, R0 and R-C pairs over SOC."""
    from chargetune.cli.identify import identify_command

    identify_command(
        data,
        out=out,
        rc=rc,
        capacity_Ah=capacity,
        ocv=ocv,
        name=name,
        figure=figure,
        check=check or [],
        temperature_C=temperature,
        branch=branch.value,
        sign=None if sign is None else sign.value,
        units=(time_unit, current_unit),
        series=series,
        parallel=parallel,
        overwrite=overwrite,
        as_json=as_json,
    )


@app.command()
def compare(
    config: ConfigFile,
    store: Annotated[str | None, typer.Option(help="Store with the study whose tuned controller is compared.")] = None,
    study: Annotated[str | None, typer.Option(help="Name of that study; the config's by default.")] = None,
    row: Annotated[list[str] | None, typer.Option(help="Only this row of the table; repeat it for several.", show_default=False)] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the draws, and of the noise that the controllers see.")] = 0,
    draws: Annotated[
        int | None,
        typer.Option(min=1, help="Plants drawn from the range of use of a study with [range]; 40 by default.", show_default=False),
    ] = None,
    workers: Workers = 2,
    figure: Annotated[Path | None, typer.Option(help="Figure to write (png, pdf, svg).")] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Charge the plant of a study file with CC-CV, step charging, nominal and tuned MPC and the plant oracle.

    With a table [range]: plants that are drawn from it, with violations and mean times.
    """
    _read_first(config, "study")
    from chargetune.cli.compare import compare_command

    compare_command(
        config,
        store=store,
        study=study,
        rows=row or [],
        seed=seed,
        draws=draws,
        workers=workers,
        figure=figure,
        overwrite=overwrite,
        as_json=as_json,
    )


@app.command()
def certify(
    store: StoreArgument,
    study: Annotated[str | None, typer.Option(help="Name of the study; needed when the store holds several.")] = None,
    trial: Annotated[int | None, typer.Option(min=0, help="Its theta is run; else that of the result of the study.")] = None,
    episodes: Annotated[int, typer.Option(min=1, help="Fresh episodes.")] = 300,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the draws.")] = 0,
    confidence: Annotated[float, typer.Option(help="Confidence of the bound on the violation probability.")] = 0.95,
    soc_start: Annotated[tuple[float, float] | None, typer.Option(help="SOC at the start: lowest and highest.", metavar="LOW HIGH")] = None,
    ambient: Annotated[
        tuple[float, float] | None, typer.Option("--ambient-K", help="Ambient temperature: lowest and highest.", metavar="LOW HIGH")
    ] = None,
    resistance: Annotated[float | None, typer.Option(help="R0, R1, .. of the plant, all in common, vary by +- this share.")] = None,
    resistance_by_node: Annotated[float | None, typer.Option(help="Each node of these tables varies by +- this share.")] = None,
    capacitance: Annotated[float | None, typer.Option(help="C1, .. of the plant, all in common, vary by +- this share.")] = None,
    capacitance_by_node: Annotated[float | None, typer.Option(help="Each node of these tables varies by +- this share.")] = None,
    node_correlation: Annotated[float | None, typer.Option(help="Correlation of neighbouring nodes of one table.")] = None,
    cells: Annotated[Path | None, typer.Option(help="Folder of cell files: plants are other cells of their make.")] = None,
    capacity: Annotated[float | None, typer.Option(help="The plant's capacity varies by +- this share.")] = None,
    fade: Annotated[float | None, typer.Option(help="Share of the capacity that is lost at full age.")] = None,
    growth: Annotated[float | None, typer.Option(help="Share by which resistances have grown at full age.")] = None,
    voltage_bias: Annotated[float | None, typer.Option("--voltage-bias-V", help="The voltage sensor is wrong by +- this.")] = None,
    workers: Workers = 1,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Certificate to write (.json); traces and figure go beside it.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Run the tuned controller on fresh episodes of its range of use and bound the probability of a violation.

    The range is that of the study's table [range], else a default one; each option changes one entry of it.
    """
    from chargetune.cli.certify import certify_command

    certify_command(
        store,
        study=study,
        trial=trial,
        episodes=episodes,
        seed=seed,
        confidence=confidence,
        changes={
            "soc_start": soc_start,
            "ambient_K": ambient,
            "resistance": resistance,
            "resistance_by_node": resistance_by_node,
            "capacitance": capacitance,
            "capacitance_by_node": capacitance_by_node,
            "node_correlation": node_correlation,
            "capacity": capacity,
            "fade": fade,
            "growth": growth,
            "voltage_bias_V": voltage_bias,
        },
        cells=cells,
        workers=workers,
        output=output,
        overwrite=overwrite,
        as_json=as_json,
    )


@app.command()
def verify(
    what: Annotated[
        str,
        typer.Argument(
            metavar="FILE",
            help="Certificate (JSON), its traces lie beside it; or a store: a file, or postgresql://user@host/database.",
            show_default=False,
        ),
    ],
    study: Annotated[str | None, typer.Option(help="Of a store this study; otherwise all.", show_default=False)] = None,
    trial: Annotated[int | None, typer.Option(help="Of a study this trial; otherwise all.", min=0, show_default=False)] = None,
    as_json: AsJson = False,
) -> None:
    """Recompute what a file says; exit code 1 and the names when some figures differ.

    Of a certificate: every figure from its traces. Of a store: every trial from its theta and seed; over a range each drawn plant.
    """
    from chargetune.cli.verify import verify_command

    verify_command(what, study=study, trial=trial, as_json=as_json)


@store_app.command("check")
def store_check(store: StoreArgument, as_json: AsJson = False) -> None:
    """Read the whole store: the database, each trial, each trace's hash; exit code 1 and what is wrong. Changes nothing."""
    from chargetune.cli.store import check_command

    check_command(store, as_json=as_json)


@store_app.command("salvage")
def store_salvage(
    store: StoreArgument,
    new: Annotated[str, typer.Argument(help="New store: a file that is not there yet, or an empty database.", show_default=False)],
    as_json: AsJson = False,
) -> None:
    """Copy what is whole of a damaged store into a new one and name what was left; copies a whole store, too."""
    from chargetune.cli.store import salvage_command

    salvage_command(store, new, as_json=as_json)


@store_app.command("export")
def store_export(
    store: StoreArgument,
    out: Annotated[Path, typer.Option(help="Folder to write to.", show_default=False)],
    study: Annotated[str | None, typer.Option(help="Name of a study; by default all.")] = None,
    form: Annotated[ExportFormat, typer.Option("--format", help="Kind of table.")] = ExportFormat.PARQUET,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Write trials and traces as tables, traces with the column names of the Battery Data Format (needs chargetune[export])."""
    from chargetune.cli.store import export_command

    export_command(store, out=out, study=study, form=form.value, overwrite=overwrite, as_json=as_json)


@store_app.command("migrate")
def store_migrate(store: StoreArgument, as_json: AsJson = False) -> None:
    """Convert a store of an older version; a copy of the old file stays beside it."""
    from chargetune.cli.store import migrate_command

    migrate_command(store, as_json=as_json)


def _read_first(path: Path, kind: str) -> None:
    """Refuse a file with a wrong key before anything heavy is imported, so that the answer comes at once."""
    from chargetune.battery.studies import study_file

    if kind == "study":
        study_file.load_config(path)
    else:
        from chargetune.battery.studies.campaign_file import CampaignFile

        study_file.read_tables(path, CampaignFile)


# What --debug said, for who reports an error after the command has ended.
_debug: list[bool] = []
# The command that runs, for who reports that it was interrupted.
_command: list[str] = []
# These keep each trial when it is told.
RESUMABLE = ("tune", "campaign", "reproduce")


def _version(value: bool) -> None:  # noqa: FBT001 - typer calls it with the option's value
    if value:
        typer.echo(f"chargetune {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")] = False,  # noqa: ARG001
    debug: Annotated[bool, typer.Option("--debug", help="With an error show where in the program it came from.")] = False,
) -> None:
    _debug.append(debug)
    _command[:] = [context.invoked_subcommand or ""]


def main() -> None:
    """Run the command line. An error a person can mend is one message and exit code 2, a defect of the program exit code 70.

    Refused input is a plain ValueError. What is derived from it is some library's (LinAlgError, UnicodeError, JSONDecodeError): where
    it comes from a user's file, who reads the file says so in a ValueError that names it. So it is a defect, and shows its traceback.
    """
    # What a service manager or a shutdown sends is as good a reason to stop in order as Ctrl-C is.
    try:
        with any_terminal(), handled_interrupts(Watch(_stopping, _interrupted)):
            app()
    except SystemExit as ended:
        # That is what typer makes of KeyboardInterrupt, without a word.
        if ended.code == INTERRUPTED:
            _interrupted()
        raise
    except KeyboardInterrupt:
        # Before the command had begun.
        _interrupted()
        sys.exit(INTERRUPTED)
    except Exception as error:  # noqa: BLE001 - what is not the user's to mend shows its traceback below
        if type(error) is ValueError or isinstance(error, OSError):
            _refuse(error)
        # Import only now: these modules are heavy, and are loaded already when one of them raised.
        from pydantic import ValidationError

        from chargetune.plants.plant import SetUpError
        from chargetune.study.identity import StudyError
        from chargetune.study.runner import WorkerError
        from chargetune.study.store.rows import StoreError

        if isinstance(error, (ValidationError, SetUpError, StudyError, StoreError, WorkerError)):
            _refuse(error)
        traceback.print_exc()
        what = f"{type(error).__name__}: {error}"
        typer.echo(f"chargetune: a defect of this program ({what}); please report it with the lines above", err=True)
        sys.exit(DEFECT)


def _stopping() -> None:
    what = "trials that are told are kept" if _resumable() else "what runs is given up"
    # Whatever stands in the line, a progress bar for instance.
    typer.echo(f"\nstopping, {what}; a second Ctrl-C ends at once", err=True)


def _interrupted() -> None:
    typer.echo(f"interrupted; the same command {'resumes' if _resumable() else 'begins again'}", err=True)


def _resumable() -> bool:
    return any(name in RESUMABLE for name in _command)


def _refuse(error: BaseException) -> NoReturn:
    if any(_debug):
        typer.echo(getattr(error, "details", "") or "".join(traceback.format_exception(error)), err=True)
    text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else str(error)
    typer.echo(f"chargetune: {text}", err=True)
    sys.exit(2)
