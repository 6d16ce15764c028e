from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch

from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.trainer import read_checkpoint


def test_a_whole_checkpoint_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    torch.save({"state_dict": {"x": torch.ones(2)}, "global_step": 7}, path)
    assert read_checkpoint(path)["global_step"] == 7


def test_damaged_and_foreign_checkpoints_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    torch.save({"state_dict": {"x": torch.ones(100)}}, path)
    whole = path.read_bytes()
    for bad in (b"", whole[: len(whole) // 2], b"no archive", pickle.dumps(Path("x"), protocol=2)):
        path.write_bytes(bad)
        with pytest.raises(FormatError, match=r"a\.ckpt: damaged, or not a checkpoint"):
            read_checkpoint(path)
    torch.save({"weights": torch.ones(2)}, path)
    with pytest.raises(FormatError, match="it has no state_dict"):
        read_checkpoint(path)
    with pytest.raises(FileNotFoundError):
        read_checkpoint(tmp_path / "none.ckpt")
