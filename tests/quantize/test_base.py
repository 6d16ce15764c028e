"""What a quantizer lacks and what it offers, with members that only an nn.Module's ``__getattr__`` finds."""

import ast
from pathlib import Path

import pytest
import torch

import nsvq_lightning
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.quantize.base import Quantizer, as_quantizer


def test_what_a_quantizer_lacks_is_named() -> None:
    class NearlyOne(NSVQ):
        freeze = property()  # type: ignore[assignment]  # reading it raises AttributeError

    assert as_quantizer(quantizer := NSVQ(4, 3)) is quantizer
    with pytest.raises(TypeError, match=r"NearlyOne is not a quantizer; it lacks: freeze; derive it from"):
        as_quantizer(NearlyOne(4, 3))
    with pytest.raises(TypeError, match=r"lacks: codebook, codes, decode, encode, fit, forward, freeze"):
        as_quantizer(object())


def test_a_codebook_that_nothing_trains_is_refused() -> None:
    quantizer = NSVQ(4, 3)
    del quantizer.codebook
    quantizer.register_buffer("codebook", torch.zeros(4, 3))
    with pytest.raises(TypeError, match=r"codebook is an nn\.Parameter"):
        as_quantizer(quantizer)


def sources() -> list[Path]:
    root = Path(nsvq_lightning.__file__).parent
    return [*root.rglob("*.py"), *(root / "callbacks").glob("*.py")]  # rglob does not follow links


def test_isinstance_meets_no_protocol() -> None:
    """With one it finds no parameter or buffer of a module since Python 3.12."""
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sources()}
    names = [node for tree in trees.values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    protocols = {node.name for node in names if any("Protocol" in ast.unparse(base) for base in node.bases)}
    assert Quantizer.__name__ in protocols
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("isinstance", "issubclass"):
                asked = {name.id for name in ast.walk(node.args[1]) if isinstance(name, ast.Name)}
                asked |= {name.attr for name in ast.walk(node.args[1]) if isinstance(name, ast.Attribute)}
                assert not asked & protocols, f"{path}:{node.lineno}: {ast.unparse(node)}"
        assert "runtime_checkable" not in path.read_text(encoding="utf-8"), path
