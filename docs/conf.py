"""How the documentation site is built: ``make docs``. Nothing is fetched from the network."""

from __future__ import annotations

import importlib.util
import logging
import sys
import warnings
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "_extensions"))

from repository_links import repository  # noqa: E402

import torchrl_hmcts  # noqa: E402

project = "torchrl_hmcts"
author = "torchrl_hmcts contributors"
project_copyright = author
version = release = torchrl_hmcts.__version__

templates_path = ["_templates"]
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "myst_parser",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "command_line_page",  # in docs/_extensions, as the next four
    "public_names",
    "repository_links",
    "results_page",
    "wide_pictures",
]
if importlib.util.find_spec("sphinx-mathjax-offline"):  # equations without a network
    extensions.append("sphinx-mathjax-offline")

root_doc = "index"
exclude_patterns = ["_build", "tutorials", "auto_tutorials/*.ipynb", "auto_tutorials/*.py"]
suppress_warnings = ["config.cache"]  # the gallery's configuration holds functions

# ------------------------------------------------------------------------- pages in Markdown
myst_enable_extensions = ["amsmath", "attrs_inline", "colon_fence", "dollarmath"]
myst_heading_anchors = 3

# ------------------------------------------------------------------------- reference
autosummary_generate = True
autodoc_default_options = {"members": True, "show-inheritance": True, "member-order": "bysource"}
autodoc_inherit_docstrings = False  # what a class has from TorchRL, TorchRL's pages tell
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 80
add_module_names = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_rtype = False
napoleon_custom_sections = ["Reference", "Writes", "Keys"]
toc_object_entries_show_parents = "hide"

# ------------------------------------------------------------------------- tutorials


def prepare_tutorial(gallery_conf: dict[str, Any], script: str) -> None:
    """Give every tutorial one thread, the same random numbers, and none of TorchRL's notes."""
    import random

    import matplotlib
    import numpy as np
    import torch

    logging.getLogger("torchrl").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*Trainer is an experimental", category=UserWarning)
    warnings.filterwarnings("ignore", message="The '.*' hook stage", category=FutureWarning)
    warnings.filterwarnings("ignore", message="Creating .*Updater", category=DeprecationWarning)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002  third-party code draws from the global generator
    random.seed(0)
    matplotlib.rcParams.update(
        {
            "figure.dpi": 110,
            "savefig.dpi": 110,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.titlelocation": "left",
            "axes.titlesize": 11,
            "figure.facecolor": "white",
        }
    )


sphinx_gallery_conf = {
    "examples_dirs": "tutorials",
    "gallery_dirs": "auto_tutorials",
    "filename_pattern": r"\.py$",
    "within_subsection_order": "FileNameSortKey",
    "remove_config_comments": True,
    "download_all_examples": False,
    "show_signature": False,
    "reset_modules": ("matplotlib", prepare_tutorial),
    "reset_modules_order": "before",
    "min_reported_time": 1,
    "show_memory": False,
    "image_srcset": ["2x"],
    "thumbnail_size": (480, 330),
    "only_warn_on_example_error": False,
    "capture_repr": (),
    "write_computation_times": False,
}

copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
copybutton_exclude = ".linenos, .gp, .go"

# ------------------------------------------------------------------------- look
html_theme = "pydata_sphinx_theme"
html_title = f"torchrl_hmcts {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sourcelink = False
html_favicon = "_static/logo.svg"
html_theme_options = {
    "logo": {
        "text": f"torchrl_hmcts {version}",
        "image_light": "_static/logo.svg",
        "image_dark": "_static/logo.svg",
    },
    "header_links_before_dropdown": 7,
    "navbar_align": "left",
    "navigation_with_keys": False,
    "show_prev_next": True,
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": ["theme-version"],
    "pygments_light_style": "tango",
    "pygments_dark_style": "monokai",
}
if address := repository(HERE.parent):  # without one there is no link
    icon = {"name": "Repository", "url": address, "icon": "fa-solid fa-code-branch"}
    html_theme_options["icon_links"] = [icon]
html_sidebars = {"index": [], "getting_started": [], "auto_results/index": [], "changelog": []}
