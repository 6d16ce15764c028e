"""How Sphinx builds the API reference: ``sphinx-build -W docs/api build/api``."""

import nsvq_lightning

project = "nsvq_lightning"
version = release = nsvq_lightning.__version__
extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon"]
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True  # the folder of the demo scene is not the same everywhere
autodoc_default_options = {"members": True, "show-inheritance": True}
# Attributes of a class are described where they are assigned or in its docstring; a second entry would be a duplicate.
napoleon_use_ivar = True
html_theme = "alabaster"
