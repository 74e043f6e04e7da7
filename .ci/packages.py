"""Are sdist and wheel whole, and does the wheel work where nothing else is? Run: make packages.

Both are built from the files of the repository. The wheel is installed in an environment without anything, which is given what the wheel
says it needs and no more, by links to the locked packages in .venv: no download, and what is not declared is missing. Everything runs there
with an empty PATH, so without a C compiler. Then each extra has an environment of its own, where the command has to work that said
before which extra it needs. ``--core`` leaves the extras and the type checker out.
"""

import argparse
import os
import re
import resource
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
import urllib.request
import venv
import zipfile
from concurrent.futures import ThreadPoolExecutor
from email import message_from_bytes
from importlib.metadata import distribution, distributions
from pathlib import Path
from textwrap import dedent

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from release import EXTRAS, ROOT, build, copy_tree, listed

# The first is raised by the import of linear_operator, on which gpytorch stands; the second is what a user without a compiler is told.
EXPECTED = ("`torch.jit.script`:DeprecationWarning", "there is no C compiler:RuntimeWarning")
WARNINGS = ("-Werror", *(f"-Wignore:{warning}" for warning in EXPECTED))
EVERY_NAME = "for name in ct.__all__:\n    getattr(ct, name)\n"
SPM = '[plant]\nmodel = "SPM"\nparameters = "Chen2020"\n\n[episode]\nsteps = 3\n'
# What the sdist holds beside the source.
BESIDE = {"CHANGELOG.md", "CITATION.cff", "LICENSE", "MANIFEST.in", "PKG-INFO", "README.md", "pyproject.toml", "setup.cfg"}
# What needs an extra: words of the command line, or lines of Python.
USES = {
    "dask": """
        from distributed import Client
        with Client(processes=False, dashboard_address=None) as client, client.get_executor() as executor:
            print(executor.submit(max, 1, 2).result())""",
    "excel": """
        from pathlib import Path
        from chargetune.battery.identification.cycler_files import read_record
        print(read_record(Path("record.xlsx")).voltage_V)""",
    "export": ["store", "export", "tank.sqlite", "--out", "tables", "--format", "parquet"],
    "gym": """
        import gymnasium, chargetune as ct
        plant = ct.GymnasiumPlant(gymnasium.make("Pendulum-v1"), [ct.Signal("u")], [ct.Signal(n) for n in "abc"], 0.05)
        print(plant.reset(0))""",
    "notebook": """
        import chargetune as ct
        from chargetune.study.dataframe import trials_dataframe
        from chargetune.study.progress import progress_bar
        with ct.Store("tank.sqlite", read_only=True) as store, progress_bar(store.trials(1), 12):
            print(trials_dataframe(ct.ParameterSpace((ct.Parameter("margin_m", 0.0, 0.3, 0.0),)), store.trials(1)))""",
    "postgres": """
        from chargetune.study.store.postgres import server_at
        server_at("postgresql://user@localhost/studies")""",
    "pybamm": ["simulate", "spm.toml"],
    "web": ["web", "tank.sqlite", "--port", "0"],
}
# Of these the package imports nothing: who has not got them learns it from an import of their own.
IMPORTED_BY_USERS = {"dask", "gym"}
TYPED = """\
import chargetune as ct


def trials(path: str) -> list[ct.Trial]:
    with ct.Store(path, read_only=True) as store:
        return store.trials(1)


space: ct.ParameterSpace = ct.ParameterSpace((ct.Parameter("margin_m", 0.0, 0.3, default=0.0),))
best: float | None = min((trial.score.objective for trial in trials("tank.sqlite") if trial.score is not None), default=None)
"""


def packages(folder):
    """The wheel, after all that can be said about it and the sdist without running them."""
    tree, again = folder / "tree", folder / "unpacked"
    copy_tree(tree)
    sdist, wheel = build("sdist", tree, folder), build("wheel", tree, folder)
    with tarfile.open(sdist) as archive:
        inside = {entry.name.partition("/")[2] for entry in archive.getmembers() if entry.isfile()}
        archive.extractall(again, filter="data")
    source = {name for name in listed() if name.startswith("src/")}
    same("the sdist", {name for name in inside if ".egg-info/" not in name}, source | BESIDE)
    held = contents(wheel)
    same("the wheel", {name for name in held if ".dist-info/" not in name}, {name.removeprefix("src/") for name in source})
    expect({"chargetune/py.typed", "chargetune/control/daqp_warm.c"} <= set(held), "py.typed or the solver's C file is not there")
    expect(any(name.endswith(".dist-info/licenses/LICENSE") for name in held), "the wheel has no LICENSE")
    second = folder / "from-sdist"
    second.mkdir()
    expect(contents(build("wheel", next(again.iterdir()), second)) == held, "the sdist builds another wheel than the repository")
    print(f"{sdist.name}: {len(inside)} files; {wheel.name}: {len(held)} files, the same from the sdist", flush=True)
    return wheel


def contents(wheel):
    """Names and checksums of what a wheel holds."""
    with zipfile.ZipFile(wheel) as archive:
        return {entry.filename: entry.CRC for entry in archive.infolist()}


def same(package, found, meant):
    """End where a package does not hold the files that it should."""
    expect(found == meant, f"{package} has {sorted(found - meant)} too much and lacks {sorted(meant - found)}")


def expect(truth, otherwise):
    """End with ``otherwise`` where ``truth`` does not hold."""
    if not truth:
        sys.exit(otherwise)


def needed(wheel, extras=()):
    """Names of the locked distributions that the wheel with these extras asks for, and what those ask for."""
    with zipfile.ZipFile(wheel) as archive:
        name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        asked = message_from_bytes(archive.read(name)).get_all("Requires-Dist", [])
    found, waiting = set(), [(line, ("", *extras)) for line in asked]
    done = set()
    while waiting:
        line, chosen = waiting.pop()
        if (line, chosen) in done:
            continue
        done.add((line, chosen))
        requirement = Requirement(line)
        if requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in chosen):
            found.add(canonicalize_name(requirement.name))
            more = distribution(requirement.name).requires or []
            waiting += [(below, ("", *sorted(requirement.extras))) for below in more]
    return found


def environment(folder, names, own=None):
    """An environment with links to the distributions ``names`` of .venv, and to chargetune in the environment ``own``; its Python."""
    venv.create(folder, symlinks=True)
    site = site_of(folder)
    if own is not None:
        for entry in site_of(own).glob("chargetune*"):
            (site / entry.name).symlink_to(entry)
    for name in names:
        found = distribution(name)
        for top, files in INSTALLED[name].items():
            # A folder that several distributions share is made of links to its files.
            alone = sum(top in theirs for theirs in INSTALLED.values()) == 1
            for file in [top] if alone else files:
                (site / file).parent.mkdir(parents=True, exist_ok=True)
                (site / file).symlink_to(found.locate_file(file))
    return folder / "bin" / "python"


def site_of(folder):
    """Where an environment has its packages."""
    return next((folder / "lib").glob("python*/site-packages"))


def installed_files():
    """Of each locked distribution: its files, by the entry of site-packages that they are or lie in."""
    found = {}
    for one in distributions():
        tops = found.setdefault(canonicalize_name(one.name), {})
        for file in map(str, one.files or ()):
            top = file.partition("/")[0]
            if top not in ("..", "__pycache__"):
                tops.setdefault(top, []).append(file)
    return found


def run(python, words, where, *, fails=False, warnings=()):
    """What a command of the program (a list) or lines of Python (a text) print."""
    rest = ["-m", "chargetune", *words] if isinstance(words, list) else ["-c", dedent(words)]
    # Isolated: no variable of the caller and no folder of his. Nothing is on the PATH.
    done = subprocess.run(
        [str(python), "-I", *warnings, *rest], cwd=where, env=bare(where), capture_output=True, text=True, timeout=300, check=False
    )
    said = done.stdout + done.stderr
    expect((done.returncode != 0) == fails, f"{' '.join(rest)}: ended with {done.returncode}\n{said}")
    return said


def bare(where):
    """The variables of an environment: no compiler, and a home of its own."""
    return {"PATH": "", "HOME": str(where), "COLUMNS": "80"}


def core(python, where):
    """What works without any extra and without a C compiler."""
    script = subprocess.run([python.with_name("chargetune"), "--version"], env=bare(where), capture_output=True, text=True, check=True)
    expect(re.fullmatch(r"chargetune [\d.]+\n", script.stdout), f"the script chargetune said {script.stdout}")
    expect(" simulate " in run(python, ["--help"], where, warnings=WARNINGS), "--help does not list the commands")
    with ThreadPoolExecutor(2) as pool:
        for done in [pool.submit(commands, python, where), pool.submit(example, python, where)]:
            done.result()
    left = [str(path) for path in where.rglob("*.so")]
    expect(not left, f"without a compiler there are {left}")
    print("without extras and without a compiler: every public name, the commands and the README's example work", flush=True)


def commands(python, where):
    """From a study file that init writes to a charge that keeps its limits."""
    run(python, ["init", "study.toml"], where, warnings=WARNINGS)
    run(python, ["check", "study.toml"], where, warnings=WARNINGS)
    said = run(python, ["simulate", "study.toml"], where, warnings=WARNINGS)
    expect(re.search(r"limits +kept", said), f"the study of init does not keep its limits without a compiler:\n{said}")


def example(python, where):
    """The README's example tunes, and every public name can be imported."""
    code = re.search(r"^```python\n(.*?)^```$", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    said = run(python, f"{code[1]}\n{EVERY_NAME}", where, warnings=WARNINGS)
    expect("status=<TrialStatus.DONE" in said, f"the README's example found nothing:\n{said}")


def write_workbook(path):
    """A smallest workbook: one sheet of three columns, three rows."""
    rows = [["Test Time / s", "Current / A", "Voltage / V"], ["0", "0", "3.6"], ["1", "1", "3.7"], ["2", "0", "3.6"]]

    def cell(text):
        return f"<c><v>{text}</v></c>" if text[0].isdigit() else f'<c t="inlineStr"><is><t>{text}</t></is></c>'

    formats = "http://schemas.openxmlformats.org"
    office, main = f"{formats}/officeDocument/2006/relationships", f"{formats}/spreadsheetml/2006/main"
    links = (
        f'<Relationships xmlns="{formats}/package/2006/relationships"><Relationship Id="a" Type="{{}}/{{}}" Target="{{}}"/></Relationships>'
    )
    with zipfile.ZipFile(path, "w") as book:
        book.writestr("_rels/.rels", links.format(office, "officeDocument", "xl/workbook.xml"))
        book.writestr("xl/_rels/workbook.xml.rels", links.format(office, "worksheet", "worksheets/sheet1.xml"))
        sheet = f'<sheet xmlns:r="{office}" name="S" sheetId="1" r:id="a"/>'
        book.writestr("xl/workbook.xml", f'<workbook xmlns="{main}"><sheets>{sheet}</sheets></workbook>')
        body = "".join(f"<row>{''.join(map(cell, row))}</row>" for row in rows)
        book.writestr("xl/worksheets/sheet1.xml", f'<worksheet xmlns="{main}"><sheetData>{body}</sheetData></worksheet>')


def extra_works(extra, wheel, folder, where):
    """Without the extra its use says which one is missing; with it, it works."""
    if extra not in IMPORTED_BY_USERS:
        said = " ".join(run(folder / "core" / "bin" / "python", USES[extra], where, fails=True).split())
        expect(f"pip install 'chargetune[{extra}]'" in said, f"without the extra {extra} it says: {said}")
    python = environment(folder / extra, needed(wheel, (extra,)), folder / "core")
    if extra == "web":
        serve(python, where)
    else:
        run(python, USES[extra], where)
    print(f"extra {extra}: works; without it the message names it", flush=True)


def serve(python, where):
    """The server answers, and ends in good order."""
    command = [str(python), "-I", "-u", "-m", "chargetune", *USES["web"]]
    with subprocess.Popen(command, cwd=where, env=bare(where), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as server:
        try:
            address = re.search(r"http://\S+", server.stdout.readline())
            expect(address, "chargetune web says no address")
            with urllib.request.urlopen(address[0], timeout=60) as answer:  # noqa: S310 - the address of this server
                expect(answer.status == 200, f"chargetune web answers {answer.status}")
        finally:
            server.send_signal(signal.SIGINT)
    expect(server.returncode == 0, f"chargetune web ended with {server.returncode}")


def types(python, where):
    """A script of a user passes mypy --strict by the annotations in the wheel."""
    (where / "typed.py").write_text(TYPED, encoding="utf-8")
    command = [sys.executable, "-m", "mypy", "--strict", "--python-executable", str(python), "--cache-dir", str(where / "mypy"), "typed.py"]
    done = subprocess.run(command, cwd=where, capture_output=True, text=True, check=False)
    expect(done.returncode == 0, f"mypy --strict: {done.stdout}{done.stderr}")
    print(f"mypy --strict of a user's script: {done.stdout.strip()}", flush=True)


def main(*, core_only):
    """Build, look, install, run."""
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as made:
        folder, where = Path(made), Path(made) / "home"
        where.mkdir()
        wheel = packages(folder)
        python = environment(folder / "core", needed(wheel))
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(python)]
        subprocess.run([*pip, "install", "--quiet", "--no-index", "--no-deps", str(wheel)], check=True)
        subprocess.run([*pip, "check"], check=True, stdout=subprocess.DEVNULL)
        (where / "spm.toml").write_text(SPM, encoding="utf-8")
        write_workbook(where / "record.xlsx")
        core(python, where)
        if not core_only:
            with ThreadPoolExecutor(2) as pool:
                list(pool.map(lambda extra: extra_works(extra, wheel, folder, where), EXTRAS))
            types(python, where)
    busy = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"packages: {time.monotonic() - begun:.0f} s, {busy.ru_utime + busy.ru_stime:.0f} s of the processor", flush=True)


if __name__ == "__main__":
    os.chdir(ROOT)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--core", action="store_true", help="leave out the extras and the type checker")
    INSTALLED = installed_files()
    main(core_only=parser.parse_args().core)
