"""How Sphinx makes the manual of these pages: ``make docs``."""

project = "pyrcal"
extensions = ["myst_parser"]
html_title = "pyrcal"
html_theme = "alabaster"
html_theme_options = {
    "description": "The calibration service of an adaptive telescope",
    "fixed_sidebar": True,
    "page_width": "75rem",
    "sidebar_width": "15rem",
    "show_powered_by": False,
    "font_family": "system-ui, sans-serif",
    "head_font_family": "system-ui, sans-serif",
}
templates_path = ["templates"]
html_static_path = ["manual.css"]
html_css_files = ["manual.css"]
html_copy_source = False
html_use_index = False
myst_heading_anchors = 3
html_sidebars = {"**": ["about.html", "searchfield.html", "navigation.html"]}

exclude_patterns = ["paper"]
