"""A name that another package has lost is said when this one is imported."""

from __future__ import annotations

import importlib
from typing import Any

import jsonargparse._typehints
import pytest
from lightning.pytorch.cli import LightningCLI
from lightning.pytorch.strategies import DDPStrategy

from nsvq_lightning.version import check_replaced


@pytest.mark.parametrize(
    ("owner", "name", "module"),
    [
        (jsonargparse._typehints, "discard_init_args_on_class_path_change", "nsvq_lightning.commands.parser"),
        (LightningCLI, "_parse_ckpt_path", "nsvq_lightning.commands.fit"),
        (LightningCLI, "_set_seed", "nsvq_lightning.commands.fit"),
        (DDPStrategy, "configure_ddp", "nsvq_lightning.training.distributed"),
    ],
)
def test_what_is_replaced_must_be_there(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, module: str) -> None:
    spec = importlib.import_module(module).__spec__
    monkeypatch.delattr(owner, name)
    with pytest.raises(ImportError, match=rf"has no {name}, which nsvq-lightning replaces: install"):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))  # type: ignore[union-attr,arg-type]


def test_what_is_there_may_be_replaced() -> None:
    check_replaced("lightning", LightningCLI, "subcommands")
