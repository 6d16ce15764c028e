from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch

from nsvq_lightning.io.errors import FormatError
from nsvq_lightning.trainer import read_checkpoint


def test_a_whole_checkpoint_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    torch.save({"state_dict": {"splats.means": torch.ones(2, 3)}, "global_step": 7}, path)
    assert read_checkpoint(path)["global_step"] == 7


def test_damaged_and_foreign_checkpoints_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.ckpt"
    torch.save({"state_dict": {"splats.means": torch.ones(100, 3)}}, path)
    whole = path.read_bytes()
    flipped = whole.replace(torch.ones(1).numpy().tobytes() * 3, torch.zeros(3).numpy().tobytes(), 1)
    assert flipped != whole  # torch alone reads it without complaint
    for bad in (b"", whole[: len(whole) // 2], flipped, b"no archive", pickle.dumps(Path("x"), protocol=2)):
        path.write_bytes(bad)
        with pytest.raises(FormatError, match=r"a\.ckpt: damaged, or not a checkpoint .*; copy it again"):
            read_checkpoint(path)
    for foreign in ({"weights": torch.ones(2)}, [1, 2], {"state_dict": {"x": torch.ones(2)}}):
        torch.save(foreign, path)
        with pytest.raises(FormatError, match="it holds no splats; give one that nsvq fit wrote"):
            read_checkpoint(path)
    for nothing in (tmp_path / "none.ckpt", tmp_path):
        with pytest.raises(FileNotFoundError, match="no such checkpoint"):
            read_checkpoint(nothing)
