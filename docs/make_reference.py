"""Write the generated pages and schemas of the reference: `make reference`."""

import importlib
import inspect
import pkgutil
from enum import Enum
from pathlib import Path

import typer

import chargetune as ct
from chargetune.battery.file_formats.bounds import Bounds
from chargetune.battery.file_formats.pages import MADE, reference
from chargetune.cli.app import app

HERE = Path(__file__).parent / "reference"
# The parts of `import chargetune as ct`, and what each is for.
LAYERS = {
    "model": "Models, signals and the space of theta",
    "control": "Controllers and estimators",
    "plants": "Plants, sensors and the range of use",
    "episode": "Closed loops and their scores",
    "learning": "Tuners",
    "study": "Studies and stores",
    "battery": "Batteries: cells, study files, identification",
}
# What a person may write own classes for: modules that define an interface, by layer.
INTERFACES = {
    "control": ("chargetune.control.estimators",),
    "plants": ("chargetune.plants.plant",),
    "learning": ("chargetune.learning.tuner", "chargetune.learning.closed_loop.loop", "chargetune.learning.twin.twin_loop"),
}


def python_pages():
    """A page for each layer: its public names, the interfaces that one may implement, and its modules in a line each."""
    found = {}
    for layer, title in LAYERS.items():
        names = [name for name in ct.__all__ if ct._MODULES.get(name, "").partition(".")[0] == layer]  # noqa: SLF001
        parts = [
            f"# {title}",
            MADE.replace("classes that read the file", "public names"),
            f"`import chargetune as ct`; module `chargetune.{layer}`.",
        ]
        parts += [_automatic(_kind(getattr(ct, name)), f"chargetune.{name}") for name in names]
        for module in INTERFACES.get(layer, ()):
            parts += [f"## Interfaces in `{module}`", _automatic("module", module)]
        parts += ["## Modules", _modules(layer)]
        found[f"python-{layer}.md"] = "\n\n".join(parts) + "\n"
    return found


def _kind(thing):
    return ("exception" if issubclass(thing, Exception) else "class") if inspect.isclass(thing) else "function"


def _automatic(kind, name):
    members = "\n   :members:" if kind != "function" else ""
    return f"```{{eval-rst}}\n.. auto{kind}:: {name}{members}\n```"


def _modules(layer):
    package = importlib.import_module(f"chargetune.{layer}")
    rows = ["| module | what it holds |", "|---|---|"]
    for found in pkgutil.walk_packages(package.__path__, f"chargetune.{layer}."):
        text = (inspect.getdoc(importlib.import_module(found.name)) or "").split("\n\n", maxsplit=1)[0].replace("\n", " ")
        text = text.replace("|", "\\|").replace("[", "\\[")
        rows += [f"| `{found.name.removeprefix('chargetune.')}` | {text} |"] if text else []
    return "\n".join(rows)


def command_page():
    """Every command with its arguments and options, from the objects that parse them."""
    intro = "Every command with its arguments and options; `chargetune COMMAND --help` prints the same. Ctrl-C ends a command in order."
    parts = ["# Command line", MADE.replace("classes that read the file", "commands"), intro]
    group = typer.main.get_command(app)
    for name, command in _commands(group):
        given = [part.name.upper() if part.required else f"[{part.name.upper()}]" for part in command.params if _is_argument(part)]
        usage = " ".join([f"chargetune {name}".strip(), *given, "[OPTIONS]", *(["COMMAND"] if hasattr(command, "commands") else [])])
        parts += [f"## {name}" if name else "## Options of every command", f"```text\n{usage}\n```", inspect.cleandoc(command.help or "")]
        rows = [_option(part) for part in command.params if part.name != "help"]
        if rows:
            parts.append("\n".join(["| argument or option | default | meaning |", "|---|---|---|", *rows]))
    return {"command-line.md": "\n\n".join(parts) + "\n"}


def _commands(group, before=""):
    """(full name, command): the group itself first, then each command in the order of --help."""
    found = [(before, group)]
    for name, command in group.commands.items():
        full = f"{before} {name}".strip()
        found += _commands(command, full) if hasattr(command, "commands") else [(full, command)]
    return found


def _is_argument(part):
    return not part.opts[0].startswith("-")


def _option(part):
    names = f"`{part.name.upper()}`" if _is_argument(part) else ", ".join(f"`{name}`" for name in (*part.opts, *part.secondary_opts))
    default = getattr(part.default, "value", part.default)
    shown = "required" if part.required else "" if default in (None, False, ()) else f"`{default}`"
    kind = _kind_of(part)
    text = f"{part.help or ''} {f'({kind})' if kind else ''}".strip().replace("|", "\\|").replace("[", "\\[")
    return f"| {names} | {shown} | {text} |"


def _kind_of(part):
    """What is typed: "number", "integer at least 1", the words of a choice."""
    kind = part.type_descriptor.annotation
    if inspect.isclass(kind) and issubclass(kind, Enum):
        return " or ".join(f"`{choice.value}`" for choice in kind)
    words = {float: "number", int: "integer", Path: "file"}.get(kind, "")
    return f"{words} {Bounds(part.min, part.max)}".strip()


if __name__ == "__main__":
    for name, text in {**reference(), **python_pages(), **command_page()}.items():
        (HERE / name).write_text(text, encoding="utf-8")
