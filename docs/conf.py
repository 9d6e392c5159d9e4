"""Settings of the documentation site: `sphinx-build -W docs docs/_build`."""

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import notebook
import option_tables

import gridworld
from gridworld.report.playground.page import maps_page

project = "gridworld"
author = "the gridworld maintainers"
copyright = author
version = release = gridworld.__version__

extensions = ["myst_parser", "sphinx_copybutton", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "examples"]
myst_enable_extensions = ["deflist"]
myst_heading_anchors = 3
default_role = "code"  # docstrings have names between single backquotes, as in Markdown
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_member_order = "bysource"
napoleon_use_ivar = True
html_theme = "furo"
html_title = "gridworld"
html_static_path = ["_static"]
html_css_files = ["site.css"]


MOVED = {  # by the address that a page had
    "tutorials/cluster": "../how-to/cluster.html",
    "how-to/environment": "worlds.html#maps-and-the-environment-without-the-rest",
    "how-to/ten-thousand-runs": "cluster.html#ten-thousand-runs",
    "tutorials/tuning": "../how-to/tuning.html",
}


def setup(app):
    """Have options and the notebook filled in, docstrings' headings set in bold, the playground written."""
    app.connect("build-finished", lambda app, _: redirect(Path(app.outdir)))
    app.connect("source-read", lambda app, name, source: fill(name, source))
    app.connect("build-finished", lambda app, _: Path(app.outdir, "playground.html").write_text(maps_page()))
    app.connect("autodoc-process-docstring", lambda app, what, name, thing, options, lines: tidy(lines))


def redirect(folder):
    """A page at each address that a page had leads to where it is now."""
    for name, place in MOVED.items():
        Path(folder, f"{name}.html").write_text(f'<meta http-equiv="refresh" content="0; url={place}">\n')


def fill(name, source):
    """Fill in the page of options and the notebook."""
    if name == "reference/options":
        source[0] = option_tables.fill(source[0])
    if name == "tutorials/quickstart":
        source[0] = source[0].replace("<!-- notebook -->", notebook.page())


def tidy(lines):
    """Headings in Markdown become bold lines, and a list begins after an empty line."""
    found = []
    for line in lines:
        heading = re.match(r"## (.*)", line)
        if heading or (
            line.startswith("- ") and found and found[-1].strip() and found[-1][:2] not in ("- ", "  ")
        ):
            found.append("")
        found += [f"**{heading[1]}**", ""] if heading else [line]
    lines[:] = found
