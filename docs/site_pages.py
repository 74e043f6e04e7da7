"""Pages that lie outside of docs/, and links that lead there: on a forge they are files, on the site they are pages or downloads."""

import re
from pathlib import Path, PurePosixPath

DOCS = Path(__file__).parent
ROOT = DOCS.parent
# Files of the repository that are a page of the site.
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changes.md",
    "benchmarks/README.md": "benchmarks.md",
}
# The scripts of examples/gallery as a reader would take them: a cell, learning, a range of use, other systems, one's own parts, machines.
GALLERY = (
    *("pulses_to_cell", "case_study", "feedback_or_learning", "safe_charges", "unmeasured_limit"),
    *("range_of_use", "measured_cells", "theta_over_temperature", "certificate"),
    *("crane", "stirred_tank", "building", "gymnasium_plant", "own_estimator"),
    *("dask_workers", "postgresql_live"),
)
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
KINDS = {"added": "Added", "changed": "Changed", "fixed": "Fixed", "removed": "Removed"}


class GalleryOrder:
    """Sphinx-gallery's key for the order of scripts: their place in `GALLERY`. ValueError for one that is not there."""

    def __init__(self, _src_dir):
        pass

    def __call__(self, file):
        return GALLERY.index(Path(file).stem)


def read_page(app, docname, source):
    """Sphinx's event source-read: the text of a page, with its links led to pages and downloads of the site."""
    page = Path(app.env.doc2path(docname))
    if page.suffix != ".md":
        return
    origin = next((ROOT / file for file, at in PAGES.items() if at == f"{docname}.md" and file != "README.md"), page)
    text = origin.read_text(encoding="utf-8") if origin != page else source[0]
    if docname == "changes":
        text += unreleased()
    text += hidden(docname, text)
    source[0] = led(text, origin.relative_to(ROOT).as_posix(), page.relative_to(ROOT).as_posix())


def hidden(docname, text):
    """Entries of the menu that nobody has to write: pages that the start page does not name, and the decision records."""
    if docname == "index":
        known = set(re.findall(r"^[\w/-]+$", text, flags=re.MULTILINE)) | {"index"}
        found = sorted(
            page.relative_to(DOCS).with_suffix("").as_posix() for folder in ("", "how-to") for page in (DOCS / folder).glob("*.md")
        )
        caption, pages = "More", [page for page in found if page not in known]
    elif docname == "decisions/README":
        caption, pages = "", sorted(page.stem for page in (DOCS / "decisions").glob("[0-9]*.md"))
    else:
        return ""
    head = "\n```{toctree}\n:hidden:\n" + (f":caption: {caption}\n" if caption else "")
    return head + "\n" + "\n".join(pages) + "\n```\n" if pages else ""


def led(text, origin, page):
    """The text of a file ``origin`` as that of ``page``, both relative to the repository: each local link leads to where it should."""

    def target(match):
        image, label, link = match.groups()
        path, mark, anchor = link.partition("#")
        if not path or re.match(r"[a-z]+:", link):
            return match[0]
        file = _plain(PurePosixPath(origin).parent / path)
        there = f"docs/{PAGES[file]}" if file in PAGES else file
        if file.startswith("examples/gallery/") and (ROOT / file).exists():
            # Its page is made from it when the site is built.
            there = f"docs/gallery/{PurePosixPath(file).stem.replace('README', 'index')}.rst"
            return f"[{label}]({_relative(there, PurePosixPath(page).parent)})"
        way = _relative(there, PurePosixPath(page).parent)
        if image or not (ROOT / there).exists() or (there.endswith(".md") and there.startswith("docs/")):
            return f"{image}[{label}]({way}{mark}{anchor})"
        if (ROOT / there).is_dir() or there.endswith(".md"):
            # What is no page of the site is a name of the repository.
            return f"{label} (`{there}`)"
        return f"{{download}}`{label.replace('`', '')} <{way}>`"

    return LINK.sub(target, text)


def unreleased():
    """What has changed since the last release, from the files of changes/."""
    parts = []
    for kind, title in KINDS.items():
        found = sorted((ROOT / "changes").glob(f"*.{kind}.md"))
        parts += (
            [f"\n## Unreleased: {title.lower()}\n", *(f"- {file.read_text(encoding='utf-8').strip()}" for file in found)] if found else []
        )
    return "\n".join(parts) + "\n"


def shown_docstring(_app, _what, _name, _obj, _options, lines):
    """Sphinx's event autodoc-process-docstring: an indented formula and a Markdown table keep their lines, bars are no substitution."""
    out, last, literal = [], 0, None
    for line in lines:
        indent = len(line) - len(line.lstrip())
        table = line.startswith("|") and line.endswith("|")
        if literal is not None and line.strip() and indent <= literal and not table:
            literal = None
        if literal is None and line.strip() and (table or (out and not out[-1].strip() and indent > last)):
            literal = last if not table else 0
            out += [" " * literal + "::", ""]
        plain = line if literal is not None else re.sub(r"\|(?=\S)([^|`]*\S)\|", r"\\|\1\\|", line)
        out.append(f"    {line}" if table else plain)
        last = indent if line.strip() and literal is None else last
    lines[:] = out


def shown_signature(_app, _what, _name, _obj, _options, signature, returned):
    """Sphinx's event autodoc-process-signature: a default that is made anew each time is shown as three dots, which Python can parse."""
    return (signature and signature.replace("<factory>", "...")), returned


def _plain(path):
    """Without dots: a/../b is b."""
    parts = []
    for part in path.parts:
        if part == "..":
            parts.pop()
        elif part != ".":
            parts.append(part)
    return "/".join(parts)


def _relative(file, folder):
    """The way from a folder to a file."""
    there, here = PurePosixPath(file).parts, folder.parts
    common = next((k for k, (a, b) in enumerate(zip(there, here, strict=False)) if a != b), min(len(there), len(here)))
    return "/".join([".."] * (len(here) - common) + list(there[common:]))
