"""Sphinx configuration of the manual: ``make docs``."""

import json
import sys
import tomllib
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.writers.html5 import HTML5Translator

sys.path.insert(0, str(Path(__file__).parents[1]))  # the API reference imports pyrcal

from service import __version__

project = "pyrcal"
copyright = "pyrcal developers"
version = release = __version__
extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
html_theme = "pydata_sphinx_theme"
html_title = "pyrcal"
html_theme_options = {
    "logo": {"text": "pyrcal"},
    "navbar_align": "left",
    "navbar_center": ["navbar-nav"],
    "navbar_end": ["release", "theme-switcher"],
    "header_links_before_dropdown": 8,
    "footer_start": ["copyright", "cite"],
    "footer_end": [],
    "show_toc_level": 2,
    "show_nav_level": 1,
    "secondary_sidebar_items": ["page-toc"],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
_project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text("utf-8"))
# The repository is linked from every page as soon as pyproject.toml names it.
html_context = {"repository": _project["project"].get("urls", {}).get("Repository", "")}
templates_path = ["templates"]
html_static_path = ["static"]
html_css_files = ["manual.css"]
html_copy_source = False
html_show_sourcelink = False
html_baseurl = ""
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["paper"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_type_aliases = {"Array": "Array", "ArrayLike": "ArrayLike"}
autosummary_generate = True
autosummary_filename_map = {"pyrcal.Fit": "pyrcal.Fit-class"}  # fit and Fit are one file on a Mac
python_use_unqualified_type_names = True
maximum_signature_line_length = 80
html_math_renderer = "mathml"
numpydoc_show_class_members = False  # the page lists members itself


class Notebook(SphinxDirective):
    """A notebook of examples/notebooks with the outputs that it was saved with."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the nodes of all cells."""
        _, path = self.env.relfn2path(self.arguments[0])
        self.env.note_dependency(path)
        found: list[nodes.Node] = []
        for cell in json.loads(Path(path).read_text(encoding="utf-8"))["cells"]:
            text = "".join(cell["source"])
            if cell["cell_type"] == "markdown":
                found += self.parse_text_to_nodes(text, allow_section_headings=True)
                continue
            found.append(nodes.literal_block(text, text, language="python"))
            for output in cell["outputs"]:
                data = output.get("data", {})
                text = "".join(output.get("text", data.get("text/plain", ""))).rstrip()
                if "image/png" in data:
                    uri = f"data:image/png;base64,{data['image/png'].strip()}"
                    found.append(nodes.image(uri=uri, alt="Figure made by the cell above"))
                elif text:
                    found.append(nodes.literal_block(text, text, language="text"))
        return found


def _remove_inline_scripts(
    app: Sphinx, pagename: str, templatename: str, context: dict[str, Any], doctree: object
) -> None:
    """Drop the theme's inline scripts: the service forbids them by its Content-Security-Policy.

    They set options of the version switcher and of the search while typing, which are not used.
    """
    context["script_files"] = [
        script
        for script in context.get("script_files", ())
        if not getattr(script, "attributes", {}).get("body")
    ]


def _inline_math(writer: HTML5Translator, node: nodes.math) -> None:
    """Write a formula as MathML, which browsers draw without a script."""
    writer.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _block_math(writer: HTML5Translator, node: nodes.math_block) -> None:
    """Write a displayed formula as MathML."""
    writer.body.append(f'<div class="formula">{convert(node.astext(), display="block")}</div>')
    raise nodes.SkipNode


def _remove_source_maps(app: Sphinx, exception: Exception | None) -> None:
    """Remove the theme's source maps, 2 MB that no reader loads."""
    for path in Path(app.outdir).rglob("*.map"):
        path.unlink()


def setup(app: Sphinx) -> None:
    """Connect the handlers of this file, after those of the theme."""
    app.add_directive("notebook", Notebook)
    app.add_html_math_renderer("mathml", (_inline_math, None), (_block_math, None))
    app.connect("html-page-context", _remove_inline_scripts, priority=950)
    app.connect("build-finished", _remove_source_maps)
