"""The site that `make docs` builds. Its sources are the repository, so that links hold in both."""

import os
import sys
from pathlib import Path

import studies

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))

# kernels of the notebooks would warn that their sockets, on this machine, are not encrypted
profile = HERE / "_build" / "ipython" / "profile_default"
profile.mkdir(parents=True, exist_ok=True)
(profile / "ipython_kernel_config.py").write_text('get_config().IPKernelApp.log_level = "ERROR"\n')
os.environ["IPYTHONDIR"] = str(profile.parent)

project = "flexlink-studies"
author = "the flexlink-studies authors"
version = release = studies.__version__
root_doc = "docs/index"
include_patterns = ["docs/**.md", "notebooks/*.ipynb", "CHANGELOG.md", "CONTRIBUTING.md"]
exclude_patterns = ["**/_build", "**/.*", "results", "build"]

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "site_pages",
    "sphinx_copybutton",
]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "cache"
nb_execution_timeout = 600  # [s], of one cell
nb_merge_streams = True

smartquotes = False  # quotes are values of fields
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
default_role = "code"
# types of libraries, whose own sites cannot be reached at every build, and types that only
# annotations name, by their modules
nitpick_ignore_regex = [
    (r"py:.*", r"(collections|matplotlib|numpy|pandas|pathlib|rich|xarray|np)\..*"),
    (r"py:.*", r"(jaxmodel|studies)\.\w+\..*"),
    (r"py:.*", r"Array|Path|[a-z_]+\.[A-Z]\w+|[A-Z]\w+"),
]

html_math_renderer = "mathml"
html_theme = "sphinx_book_theme"
html_title = project
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"show_navbar_depth": 1, "use_download_button": False}
