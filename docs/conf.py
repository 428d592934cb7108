"""Sphinx configuration of the manual: ``make docs``."""

import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
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
    "sphinx_design",
]
html_theme = "pydata_sphinx_theme"
html_title = "pyrcal"
html_theme_options = {
    "logo": {"text": "pyrcal"},
    "navbar_align": "left",
    "navbar_center": ["navbar-nav"],
    "navbar_end": ["theme-switcher"],
    "header_links_before_dropdown": 8,
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_toc_level": 2,
    "show_nav_level": 1,
    "secondary_sidebar_items": ["page-toc"],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
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
autodoc_type_aliases = {"Array": "Array"}
html_math_renderer = "mathml"
numpydoc_show_class_members = False  # the page lists members itself


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
    app.add_html_math_renderer("mathml", (_inline_math, None), (_block_math, None))
    app.connect("html-page-context", _remove_inline_scripts, priority=950)
    app.connect("build-finished", _remove_source_maps)
