"""How Sphinx builds the API reference: ``sphinx-build -W docs/api build/api``."""

from typing import Any, get_type_hints

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


def begin_attribute(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Begin the text of an attribute with an empty comment: Napoleon takes what a colon follows for its type."""
    if what in ("attribute", "property"):
        lines[:0] = ["..", ""]


def plain_types(app: Any, obj: Any, bound_method: bool) -> None:
    """Leave the bounds of settings out of signatures; each setting has its own below."""
    if "Annotated" in str(getattr(obj, "__annotations__", "")):
        obj.__annotations__ = get_type_hints(obj)


def setup(app: Any) -> None:
    """Change what is read before Napoleon and autodoc do."""
    app.connect("autodoc-process-docstring", begin_attribute, priority=400)
    app.connect("autodoc-before-process-signature", plain_types)
