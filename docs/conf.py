"""Settings of the documentation site: `sphinx-build -W docs docs/_build`."""

import re
import sys
import tomllib
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

sys.path.insert(0, str(Path(__file__).parent))

import notebook
import option_tables

import gridworld
from gridworld.report.playground.page import FRAME, maps_page

README = Path(__file__).parent.with_name("README.md")
PROJECT = tomllib.loads(README.with_name("pyproject.toml").read_text("utf-8"))["project"]
ADDRESS = PROJECT.get("urls", {}).get("Repository")

project = "gridworld"
author = "the gridworld maintainers"
copyright = author
version = release = gridworld.__version__

extensions = ["myst_parser", "sphinx_copybutton", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown", ".ipynb": "markdown"}  # `fill` makes Markdown of notebooks
exclude_patterns = ["_build", "examples", "course/solutions"]
myst_enable_extensions = ["deflist", "html_image"]
myst_heading_anchors = 3
default_role = "code"  # docstrings have names between single backquotes, as in Markdown
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_member_order = "bysource"
napoleon_use_ivar = True
html_theme = "furo"
html_math_renderer = "mathml"
html_title = "gridworld"
icon = {"name": "Repository", "url": ADDRESS, "html": "Repository", "class": ""}
html_theme_options = {"footer_icons": [icon] if ADDRESS else []}
html_static_path = ["_static"]
html_css_files = ["site.css"]
MATH = '---\nmyst: {enable_extensions: ["dollarmath"]}\n---\n'


MOVED = {  # by the address that a page had
    "tutorials/cluster": "../how-to/cluster.html",
    "how-to/environment": "worlds.html#maps-and-the-environment-without-the-rest",
    "how-to/ten-thousand-runs": "cluster.html#ten-thousand-runs",
    "reference/rooms": "how-a-run-works.html#the-rooms",
    "tutorials/tuning": "../how-to/tuning.html",
}


def setup(app):
    """Have pages filled in, docstrings' headings set in bold, formulas drawn, the playground written."""
    app.connect("source-read", lambda app, name, source: fill(app.env.doc2path(name), source))
    app.connect("build-finished", lambda app, _: redirect(Path(app.outdir)))
    app.add_html_math_renderer("mathml", (formula, None), (formula, None))
    app.connect("build-finished", lambda app, _: Path(app.outdir, "playground.html").write_text(maps_page()))
    app.connect("autodoc-process-docstring", lambda app, what, name, thing, options, lines: tidy(lines))


def redirect(folder):
    """A page at each address that a page had leads to where it is now."""
    for name, place in MOVED.items():
        Path(folder, f"{name}.html").write_text(f'<meta http-equiv="refresh" content="0; url={place}">\n')


def fill(path, source):
    """Fill in the start page and those of options and of the notebook, and make a page of a lab sheet."""
    if path.match("docs/index.md"):
        start = README.read_text("utf-8").split("<!-- Until here")[0]
        start = start.replace("(docs/examples/quickstart.ipynb)", "(docs/tutorials/quickstart.md)")
        source[0] = source[0].replace("<!-- README.md, until it says so -->", start.replace("docs/", ""))
        frame = FRAME.format('src="playground.html"')
        source[0] = source[0].replace("<!-- the playground -->", f"```{{raw}} html\n{frame}\n```")
    if path.match("reference/options.md"):
        source[0] = option_tables.fill(source[0])
    if path.match("tutorials/quickstart.md"):
        shown = notebook.page(notebook.NOTEBOOK.read_text("utf-8"))
        source[0] = source[0].replace("<!-- notebook -->", shown.split("\n", 1)[1])  # without its title
    if path.suffix == ".ipynb":
        title, rest = notebook.page(source[0]).split("\n", 1)
        source[0] = f"{MATH}{title}\n\n{{download}}`The notebook <{path.name}>`, to work in.\n{rest}"


def formula(translator, node):
    """Draw a formula in MathML, for which a page loads nothing."""
    translator.body.append(str(tex2mathml(node.astext(), as_block=isinstance(node, nodes.math_block))))
    raise nodes.SkipNode


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
