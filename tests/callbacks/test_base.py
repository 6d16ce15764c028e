"""What a module must have to host the callbacks is said by each of them, once, in the same words."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from nsvq_lightning import callbacks
from nsvq_lightning.callbacks.progress import SplatProgressBar
from nsvq_lightning.splats.splats import Splats
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.optim import LearningRates, param_groups

HOSTED = [
    kind
    for name in callbacks.__all__
    if isinstance(kind := getattr(callbacks, name), type)
    and issubclass(kind, Callback)
    and kind is not callbacks.RenderWriter  # it works with any module that predicts pictures
    and kind is not callbacks.CompileAhead  # it does nothing with other modules
    and kind is not SplatProgressBar  # it edits no parameters
]


class StandIn(Trainer):
    """A trainer with the optimisers of its module, as if a fit had begun."""

    def __init__(self, module: LightningModule, optimizers: list[torch.optim.Optimizer] | None = None) -> None:
        super().__init__(accelerator="cpu", logger=False, enable_checkpointing=False, max_steps=10)
        module._trainer = self
        self.optimizers = [torch.optim.Adam(module.parameters())] if optimizers is None else optimizers


def host() -> SplatModule:
    module = SplatModule(sh_degree=0, codebooks={"scales": 4}, splats=Splats(0))
    module.extent = 1.0
    return module


@pytest.mark.parametrize("kind", [*HOSTED, SplatProgressBar])
def test_a_module_without_splats_is_refused_before_anything_starts(kind: type[Callback]) -> None:
    module = LightningModule()
    with pytest.raises(TypeError, match=r"LightningModule cannot host the splat callbacks, it lacks: .*splats, "):
        kind().setup(StandIn(module, []), module, "fit")


class Delegate(LightningModule):
    """Answers for the module that it holds; what is set on it does not reach that one."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = host()

    def __getattr__(self, name: str) -> Any:
        return super().__getattr__(name) if name == "inner" else getattr(self.inner, name)


def test_a_module_that_passes_on_to_a_host_is_told_to_derive_from_it() -> None:
    module = Delegate()
    with pytest.raises(TypeError, match=r"Delegate cannot host .* holds a SplatModule .* derive Delegate from Splat"):
        callbacks.PhaseSchedule().setup(StandIn(module, []), module, "fit")


@pytest.mark.parametrize("kind", HOSTED)
@pytest.mark.parametrize("names", [{}, {"codebook_scales": "codebook"}])
def test_an_optimiser_whose_groups_have_other_names_is_refused(kind: type[Callback], names: dict[str, str]) -> None:
    module = host()
    groups: list[dict[str, Any]] = param_groups(module.splats, module.codebooks, LearningRates(), 1.0)  # type: ignore[arg-type]
    renamed = [group | {"name": names[group["name"]]} if group["name"] in names else group for group in groups]
    optimizers: list[torch.optim.Optimizer] = [torch.optim.Adam(renamed)] if names else []
    lacking = "codebook_scales" if names else "means, quats, scales, opacities, sh0, shN, codebook_scales"
    callback, trainer = kind(), StandIn(module, optimizers)
    callback.setup(trainer, module, "fit")
    with pytest.raises(
        ValueError, match=rf"cannot host .* {len(optimizers)} optimisers, without groups for: {lacking}"
    ):
        callback.on_train_start(trainer, module)
