from __future__ import annotations

import pytest
import torch

from nsvq_lightning.commands.doctor import self_test
from nsvq_lightning.rendering.rasterize import Render, render


def test_the_cpu_kernels_pass() -> None:
    (finding,) = (found for found in self_test.check_rendering() if found.values["backend"] == "cpu")
    assert finding.verdict == "good"
    assert set(finding.values["errors"]) == {"image", "means", "quats", "scales", "opacities", "sh0", "shN"}
    assert 0 < max(finding.values["errors"].values()) < 1e-4


@pytest.mark.parametrize("factor", [1.01, float("nan")])
def test_wrong_kernels_fail(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    def wrong(splats, camera, *, background, backend):  # type: ignore[no-untyped-def]
        result = render(splats, camera, background=background, backend=backend)
        return Render(result.image * factor, *result[1:]) if backend == "cpu" else result

    monkeypatch.setattr(self_test, "render", wrong)
    monkeypatch.setattr(self_test, "usable_backends", lambda: {"cpu": "cpu"})
    (finding,) = self_test.check_rendering()
    assert finding.verdict == "problem"
    assert "image" in finding.text
    assert "opacities" in finding.text


def test_errors_are_relative_to_the_oracle() -> None:
    truth = {"image": torch.tensor([3.0, 4.0], dtype=torch.float64)}
    assert self_test.rendering_errors({"image": torch.tensor([3.0, 4.5])}, truth)["image"] == pytest.approx(0.1)
