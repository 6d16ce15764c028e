"""What the module renders and trains in each phase; checkpoints hold plain data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from torch import Tensor, nn

from nsvq_lightning.callbacks import CodebookInit, PhaseSchedule
from nsvq_lightning.data.datamodule import ColmapDataModule
from nsvq_lightning.data.scene import View
from nsvq_lightning.io import load, save
from nsvq_lightning.io.nsvq.precision import Storage
from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.quantize import NSVQ
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.frame import Frame
from nsvq_lightning.rendering.rasterize import render, visible
from nsvq_lightning.splats.attributes import ATTRIBUTES
from nsvq_lightning.splats.splats import RawSplats, Splats
from nsvq_lightning.training.module import SplatModule
from nsvq_lightning.training.schedule import Phase
from nsvq_lightning.training.trainer import SplatTrainer

CODES = {"scales": 6, "quats": 5, "sh0": 4, "shN": 3}


def make_splats(n: int = 30) -> Splats:
    g = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g)

    means = rand(n, 3) * 0.5
    means[:5, 2] = -50.0  # behind the camera
    return Splats.from_tensors(means, rand(n, 4), rand(n, 3) * 0.2 - 2, rand(n), rand(n, 1, 3), rand(n, 3, 3) * 0.1)


def camera(width: int = 40, height: int = 30) -> Camera:
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3.0
    K = torch.tensor([[35.0, 0.0, width / 2], [0.0, 35.0, height / 2], [0.0, 0.0, 1.0]])
    return Camera(K, viewmat, width, height)


@pytest.fixture
def module() -> SplatModule:
    built = SplatModule(sh_degree=1, codebooks=CODES, splats=make_splats())
    built.active_sh_degree = 1
    for name, quantizer in built.quantizers.items():
        quantizer.fit(built.scene.rows(name), generator=generator(0, 0, name))
    # Steps and ranks come from a trainer; there is none here.
    built._trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, max_steps=10)
    return built.train()


def test_warm_up_renders_the_raw_splats(module: SplatModule) -> None:
    expected = render(module.splats.raw(), camera(), sh_degree=1)
    assert torch.equal(module(camera()).image, expected.image)
    module.active_sh_degree = 0
    assert not torch.equal(module(camera()).image, expected.image)


def test_quantizing_renders_the_visible_splats_with_noise_of_the_right_length(
    module: SplatModule, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[RawSplats] = []

    def spy(splats: RawSplats, view: Camera, **settings: Any) -> Any:
        seen.append(splats)
        return render(splats, view, **settings)

    monkeypatch.setattr("nsvq_lightning.training.splat_scene.render", spy)
    module.phase = Phase.QUANTIZE
    module(camera())
    rows = visible(module.splats.raw(), camera())
    assert 0 < len(rows) <= 25
    used = seen[0]
    assert torch.equal(used.means, module.splats.means[rows])
    assert torch.equal(used.opacities, module.splats.opacities[rows])
    for name, quantizer in module.quantizers.items():
        raw = module.scene.rows(name)[rows]
        hard = quantizer.decode(quantizer.encode(raw)).detach()
        moved = (getattr(used, name).detach().reshape(len(rows), -1) - raw).norm(dim=1)
        torch.testing.assert_close(moved, (hard - raw).norm(dim=1), rtol=1e-4, atol=1e-5)
    module(camera())
    assert torch.equal(seen[0].scales, seen[1].scales)  # one step, one noise
    assert [int(quantizer.window) for quantizer in module.quantizers.values()] == [2, 2, 2, 2]


def test_evaluation_in_the_quantize_phase_uses_hard_codes(module: SplatModule) -> None:
    module.phase = Phase.QUANTIZE
    module.eval()
    expected = render(module.compressed().decode(), camera(), sh_degree=1)
    assert torch.equal(module(camera()).image, expected.image)
    assert all(int(quantizer.window) == 0 for quantizer in module.quantizers.values())
    hard = module.scene.hard_splats(Phase.QUANTIZE)
    assert torch.equal(render(hard, camera()).image, expected.image)
    assert torch.equal(module.scene.hard_splats(Phase.PRUNE).scales, module.splats.scales)


def test_fine_tuning_trains_codebooks_positions_and_opacities_only(module: SplatModule) -> None:
    module.phase = Phase.FINETUNE
    for name, quantizer in module.quantizers.items():
        quantizer.freeze(quantizer.encode(module.scene.rows(name)))
    module(camera()).image.square().mean().backward()
    assert {name for name in ATTRIBUTES if getattr(module.splats, name).grad is not None} == {"means", "opacities"}
    assert all(quantizer.codebook.grad is not None for quantizer in module.quantizers.values())
    book = module.quantizers["scales"].codebook.grad
    assert book is not None
    assert book.any()


@pytest.mark.parametrize("wanted", [True, False])
def test_the_loss_is_for_psnr_once_splats_no_longer_grow(wanted: bool, module: SplatModule) -> None:
    module.psnr_loss = wanted
    photo = torch.rand(30, 40, 3)
    view = View("a.png", 0, camera(), photo)
    with torch.no_grad():
        rendered = module(view.camera)
        for phase in Phase:
            module.phase = phase
            expected = photometric_loss(rendered.image, photo, 0.2, psnr=wanted and phase is not Phase.WARMUP)
            assert torch.equal(module.loss_terms["photometric"](rendered, view), expected)


def test_random_backgrounds_change_with_the_step_and_not_in_evaluation(module: SplatModule) -> None:
    random = SplatModule(sh_degree=1, codebooks=None, background="random", splats=make_splats())
    random._trainer = module._trainer
    first = random.train()(camera()).image
    random._view_of_step = 1
    assert not torch.equal(first, random(camera()).image)
    assert torch.equal(random.eval()(camera()).image, module(camera()).image)  # black
    assert float(random(camera()).image[0, 0].detach().min()) >= 0.0
    white = SplatModule(sh_degree=1, codebooks=None, background="white", splats=make_splats())
    white._trainer = module._trainer
    black = SplatModule(sh_degree=1, codebooks=None, splats=make_splats())
    black._trainer = module._trainer
    alpha = black(camera()).alpha
    torch.testing.assert_close(white(camera()).image, black(camera()).image + (1 - alpha)[..., None])


def test_a_loss_that_is_not_finite_skips_the_update(
    module: SplatModule, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    view = View("a.png", 0, camera(), torch.zeros(30, 40, 3, dtype=torch.uint8))
    assert module.training_step(view, 0) is not None
    monkeypatch.setattr(
        "nsvq_lightning.training.module.photometric_loss", lambda image, *_, **__: image.sum() * torch.nan
    )
    assert module.training_step(view, 0) is None
    assert "the loss of a.png is nan, no update" in caplog.text


def test_terms_of_the_loss_are_added(module: SplatModule) -> None:
    view = View("a.png", 0, camera(), torch.zeros(30, 40, 3, dtype=torch.uint8))
    alone = module.training_step(view, 0)
    module.loss_terms["more"] = lambda rendered, seen: 0.01 * rendered.alpha.sum() + seen.index
    more = module.training_step(view, 0)
    assert alone is not None
    assert more is not None
    total = float(alone["render"].alpha.detach().sum())
    assert (more["loss"] - alone["loss"]).item() == pytest.approx(0.01 * total, rel=1e-4)


def test_the_phase_and_its_numbers_are_in_the_state_and_an_optimiser_of_other_groups_is_refused(
    module: SplatModule,
) -> None:
    module.phase, module.active_sh_degree, module.extent, module.stopwatch.seconds = Phase.PRUNE, 1, 1.5, 12.25
    other = SplatModule(sh_degree=1, codebooks=CODES, splats=make_splats())
    other.load_state_dict(module.state_dict())
    assert (other.phase, other.active_sh_degree, other.extent, other.stopwatch.seconds) == (Phase.PRUNE, 1, 1.5, 12.25)
    groups = module.configure_optimizers().param_groups
    renamed = [group | {"name": group["name"].replace("codebook_scales", "codebook")} for group in groups]
    for optimizers, missing in (([], "means, quats"), ([torch.optim.Adam(renamed)], "codebook_scales")):
        module.trainer.optimizers = optimizers
        with pytest.raises(ValueError, match=rf"there are {len(optimizers)} optimisers, without groups for: {missing}"):
            module.on_train_start()


def test_what_is_not_a_quantizer_is_refused() -> None:
    with pytest.raises(TypeError, match="Linear is not a quantizer"):
        SplatModule(quantizer=nn.Linear)
    with pytest.raises(ValueError, match="unknown attributes albedo"):
        SplatModule(codebooks={"albedo": 4})
    with pytest.raises(ValueError, match="scales needs at least 1 code"):
        SplatModule(codebooks={"scales": 0})
    with pytest.raises(ValueError, match="background must be"):
        SplatModule(background="green")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dtype": torch.float64}, r"the codebook of scales must be \[K, 3\] float32, it is \[4, 3\] torch\.float64"),
        ({"dim": 5}, r"the codebook of scales must be \[K, 3\] float32, it is \[4, 5\] torch\.float32"),
    ],
)
def test_a_codebook_of_another_kind_is_refused_before_training(change: dict[str, Any], words: str) -> None:
    def make(codes: int, dim: int) -> nn.Module:
        return NSVQ(codes, change.get("dim", dim)).to(change.get("dtype", torch.float32))

    with pytest.raises(TypeError, match=f"NSVQ: {words}"):
        SplatModule(quantizer=make, codebooks={"scales": 4})


def test_a_trained_module_cannot_be_trained_from_the_start(module: SplatModule) -> None:
    module.phase = Phase.FINETUNE
    module.trainer.optimizers = [module.configure_optimizers()]  # type: ignore[list-item]
    with pytest.raises(ValueError, match="already trained into its finetune phase"):
        PhaseSchedule().on_train_start(module.trainer, module)


def test_given_splats_stay_as_they_are(demo_scene: Path) -> None:
    splats = make_splats()
    before = [tensor.detach().clone() for tensor in splats.raw()]
    module = SplatModule(sh_degree=1, codebooks=None, splats=splats)
    trainer = SplatTrainer(max_steps=4, callbacks=[], enable_checkpointing=False, enable_progress_bar=False)
    trainer.fit(module, ColmapDataModule(demo_scene))
    assert all(torch.equal(one, other) for one, other in zip(splats.raw(), before, strict=True))
    assert not torch.equal(module.splats.means, splats.means)


def test_splats_of_another_precision_are_trained_in_float32() -> None:
    splats = SplatModule(codebooks=None, splats=make_splats().double()).splats
    assert {parameter.dtype for parameter in splats.parameters()} == {torch.float32}
    assert torch.equal(splats.means, make_splats().means)


def test_a_module_renders_what_its_file_holds_once_it_was_trained(demo_scene: Path) -> None:
    phases = PhaseSchedule(total=12, reference_total=None, warmup_end=2, prune_end=4, quantize_end=11, min_finetune=1)
    trainer = SplatTrainer(max_steps=8, callbacks=[phases, CodebookInit()], enable_checkpointing=False, logger=False)
    module = SplatModule(codebooks={"sh0": 4}, quantizer=NSVQ)
    module.eval()  # as after a look at it
    trainer.fit(module, ColmapDataModule(demo_scene, factor=2))
    assert not module.training
    view = trainer.datamodule.scene.view(0)  # type: ignore[attr-defined]
    found = module(view.camera)
    stored = module.compressed()
    expected = render(stored.decode(), view.camera, background=stored.background)
    torch.testing.assert_close(found.image, expected.image, atol=2e-3, rtol=0)
    torch.testing.assert_close(found.depth, expected.depth, atol=1e-2, rtol=1e-3)


def test_a_module_made_double_is_refused_at_once(demo_scene: Path) -> None:
    trainer = SplatTrainer(max_steps=4, callbacks=[], enable_checkpointing=False, enable_progress_bar=False)
    with pytest.raises(ValueError, match="splats train in float32"):
        trainer.fit(SplatModule(codebooks=None).double(), ColmapDataModule(demo_scene))


def test_a_module_is_saved_where_its_files_are(
    module: SplatModule, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    module.frame = Frame(2.0, (1.0, 2.0, 3.0))
    save(module, tmp_path / "scene.ply")
    assert "coordinates of training" not in caplog.text
    expected = 2 * module.splats.means.detach() + torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(load(tmp_path / "scene.ply").means.detach(), expected)
    module.splats.edits = 1  # as once splats have grown
    for use in (lambda: save(module.splats, tmp_path / "scene.ply"), lambda: render(module.splats, camera())):
        caplog.clear()
        use()
        assert "in coordinates of training: give the module itself" in caplog.text
    caplog.clear()
    module(camera())
    other = SplatModule(sh_degree=1, codebooks=CODES, splats=make_splats())
    save(other.splats, tmp_path / "scene.ply")
    assert not caplog.text
    other.load_state_dict(module.state_dict())
    save(other.splats, tmp_path / "scene.ply")
    assert "in coordinates of training: give the module itself" in caplog.text


def test_settings_of_a_checkpoint_are_those_of_the_splats_and_plain_numbers(demo_scene: Path, tmp_path: Path) -> None:
    module = SplatModule(codebooks=None, splats=make_splats(), seed=np.int64(3))  # type: ignore[arg-type]
    trainer = SplatTrainer(max_steps=1, callbacks=[], enable_checkpointing=False, enable_progress_bar=False)
    trainer.fit(module, ColmapDataModule(demo_scene))
    assert type(module.seed) is int
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    found = SplatModule.load_from_checkpoint(tmp_path / "a.ckpt")
    assert found.splats.sh_degree == module.splats.sh_degree == 1
    assert torch.equal(found.splats.means, module.splats.means)
    assert save(found, tmp_path / "a.nsvq") == save(module, tmp_path / "b.nsvq")


def test_a_state_alone_knows_what_is_behind_the_splats_and_from_where_they_were_seen(module: SplatModule) -> None:
    module.background, module.cameras = "white", np.array([[0.0, 1.0, 2.0, 300.0], [3.0, 4.0, 5.0, 310.0]])
    other = SplatModule(sh_degree=1, codebooks=CODES)
    other.load_state_dict(module.state_dict())
    assert other.background == "white"
    assert np.array_equal(other.cameras, module.cameras)
    chosen = SplatModule(sh_degree=1, codebooks=CODES, background="black")
    chosen.load_state_dict(module.state_dict())
    assert chosen.background == "black"


def test_the_level_of_the_file_is_enough() -> None:
    assert SplatModule(storage="paper").storage == Storage("paper")  # type: ignore[arg-type]  # as save takes it
    with pytest.raises(ValueError, match="unknown compression level 'papers'"):
        SplatModule(storage="papers")  # type: ignore[arg-type]


def test_trained_splats_are_rendered_with_all_their_coefficients() -> None:
    splats = Splats.from_points(torch.randn(5, 3), torch.rand(5, 3), 2)
    assert SplatModule(splats=splats).active_sh_degree == 2
    assert SplatModule(sh_degree=2).active_sh_degree == 0  # from points, the degree grows
