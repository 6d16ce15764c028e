"""Lightning data modules: any scene, a scene folder, and the embedded demo scene."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from lightning.pytorch.overrides.distributed import UnrepeatedDistributedSampler
from lightning.pytorch.utilities import rank_zero_info
from torch.utils.data import DataLoader, Dataset, IterableDataset, get_worker_info

from nsvq_lightning.data.colmap import SceneError, size_range
from nsvq_lightning.data.images import Picture
from nsvq_lightning.data.scene import Factor, Scene, View, load_scene, spread, uneven, usable
from nsvq_lightning.random import generator
from nsvq_lightning.top_level import log


def view_order(n_views: int, seed: int, rank: int = 0, world_size: int = 1, start: int = 0) -> Iterator[int]:
    """Endless sequence of views: all in random order without replacement, then all again in a new order.

    Epoch ``e`` of the sequence is a permutation drawn from ``generator(seed, e, "views")``. Draw ``d`` of rank ``r`` of
    ``R`` ranks takes position ``d·R + r``, so the ranks share one sequence, and a run resumed at draw ``d`` continues
    exactly where it stopped.

    Args:
        n_views: Number of views, at least 1.
        seed: Seed of the run.
        rank: This process.
        world_size: Number of processes.
        start: Draw at which iteration starts.
    """
    current = -1
    order = torch.empty(0)
    for draw in count(start):
        epoch, position = divmod(draw * world_size + rank, n_views)
        if epoch != current:
            current = epoch
            order = torch.randperm(n_views, generator=generator(seed, epoch, "views"))
        yield int(order[position])


class DevicePhotos:
    """Moves views to a device and keeps their photos there, the first ones while a budget lasts.

    A photo is 5 MB that would cross the bus at every step. As in :class:`~nsvq_lightning.data.images.ImageStore`, what
    is kept stays: under a random order that is as good as anything.

    Args:
        most_bytes: Memory for photos on the device in bytes; on a GPU, a quarter of what is free if that is less.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most = most_bytes
        self._free = 0
        self._device = torch.device("cpu")
        self._kept: dict[tuple[int, tuple[int, int]], View] = {}

    def move(self, view: View, device: torch.device) -> View:
        """The view with its photo and mask on the device."""
        if device.type == "cpu":
            return view.to(device)
        if device != self._device:
            self._device = device
            self._kept = {}
            self._free = min(self._most, _spare(device))
        key = view.index, view.camera.size  # one's own data may give a view in several sizes
        if key in self._kept:
            return self._kept[key]
        moved = view.to(device)
        taken = Picture(moved.image, moved.mask).nbytes
        if taken <= self._free:
            self._kept[key] = moved
            self._free -= taken
        return moved


def _spare(device: torch.device) -> int:
    """Bytes of a device's memory that photos may take: a quarter of a GPU's that is free, as splats grow."""
    return torch.cuda.mem_get_info(device)[0] // 4 if device.type == "cuda" else 1 << 62


# Folder of the demo scene, a COLMAP scene as any other; nothing is ever written there.
DEMO = Path(__file__).parent / "demo"


# Test views that are looked at during a run. With all of 3000 photos, that would take as long as to train.
VALIDATED = 50


class SceneDataModule(LightningDataModule):
    """Views of a scene, one per batch.

    The train views come in the endless order of :func:`~nsvq_lightning.data.datamodule.view_order`, which starts at the
    trainer's step: a resumed run sees the views that the uninterrupted run would have seen. With R processes, each
    takes its own draws of that one sequence, and every R-th of the test views.

    Args:
        scene: The scene, or what loads it when it is first used.
        seed: Seed of the order of the train views.
        cache_bytes: Bytes for photos on a GPU.
    """

    def __init__(self, scene: Scene | Callable[[], Scene], seed: int = 0, cache_bytes: int = 4 << 30) -> None:
        super().__init__()
        self.seed = seed
        self._scene = scene
        self._photos = DevicePhotos(cache_bytes)

    @cached_property
    def scene(self) -> Scene:
        """The scene, loaded at first use.

        Raises:
            SceneError: The folder cannot be used.
        """
        if isinstance(self._scene, Scene):
            return self._scene
        scene = usable(self._scene())
        rank_zero_info(_summary(scene))
        if remark := uneven(scene):
            log.warning(f"the photos of {scene.root} {remark}")
        return scene

    def setup(self, stage: str | None = None) -> None:
        """Load the scene; further calls do nothing.

        Raises:
            SceneError: The folder cannot be used, or there are fewer views to test on, or predict, than processes,
                which would otherwise fail only at the first evaluation.
        """
        number, views = (len(self.scene), "views") if stage == "predict" else (len(self.scene.test), "test views")
        if number < self.process[1]:
            processes = f"{self.process[1]} processes: use fewer devices, or more {views}"
            raise SceneError(f"{number} {views} cannot be shared by {processes}")

    def train_dataloader(self) -> DataLoader[View]:
        """Endless train views from the trainer's step on; limit the run with ``max_steps``."""
        return DataLoader(_TrainViews(self), batch_size=None)

    def val_dataloader(self) -> DataLoader[View]:
        """This process's share of at most :data:`VALIDATED` test views, evenly taken, in the order of their names."""
        return self._ordered(spread(self.scene.test, VALIDATED))

    def test_dataloader(self) -> DataLoader[View]:
        """This process's share of the test views, in the order of their names."""
        return self._ordered(self.scene.test)

    def predict_dataloader(self) -> DataLoader[View]:
        """This process's share of all views, in the order of their names."""
        return self._ordered(sorted((*self.scene.train, *self.scene.test)))

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        """Move a view to the device of the splats; on a GPU its photo stays there while the memory for photos lasts."""
        return self._photos.move(batch, device)

    @property
    def process(self) -> tuple[int, int]:
        """Rank of this process and their number; ``(0, 1)`` without a trainer."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    @property
    def draw(self) -> int:
        """Number of train views that each process had drawn when the trainer's current state was reached.

        Those that ``overfit_batches`` repeats count once.
        """
        if self.trainer is None:
            return 0
        # Lightning types the base of its counters.
        drawn = int(self.trainer.fit_loop.epoch_loop.batch_progress.total.processed)  # type: ignore[attr-defined]
        repeated = int(self.trainer.overfit_batches)  # type: ignore[attr-defined]
        return drawn % repeated if repeated else drawn

    def _ordered(self, indices: Sequence[int]) -> DataLoader[View]:
        rank, world_size = self.process
        views = _OrderedViews(self.scene, indices, world_size)
        # Lightning leaves a DistributedSampler alone, whatever use_distributed_sampler says; this one pads nothing.
        sampler = UnrepeatedDistributedSampler(views, world_size, rank, shuffle=False)
        return DataLoader(views, batch_size=None, sampler=sampler)


class ColmapDataModule(SceneDataModule):
    """Views of a scene folder, one per batch.

    Every 8th of the sorted image names is a test view (validated and tested on, never trained on), unless the folder
    says which are, see :func:`~nsvq_lightning.data.scene.load_scene`.

    Args:
        root: Scene folder: photos with a COLMAP model or a ``transforms.json``.
        factor: Divide the image size by 1, 2, 4 or 8; None: see ``max_width``.
        max_width: Without a factor, scale wider images down to it; None: never.
        test_every: Every ``test_every``-th view is a test view, at least 2.
        seed: Seed of the order of the train views.
        cache_bytes: Bytes for decoded images; what does not fit is decoded anew.
        images_folder: Name of the image folder.
        model: What to read instead of ``sparse`` or ``sparse/0``: a number, a folder or a ``.json``.
        masks: Name of the folder of masks; None ignores them.
        allow_outside: Also read photos and masks that the model names outside ``root``.
    """

    def __init__(
        self,
        root: str,
        factor: Factor | None = None,
        max_width: int | None = 1600,
        test_every: int = 8,
        seed: int = 0,
        cache_bytes: int = 4 << 30,
        images_folder: str = "images",
        model: str | None = None,
        masks: str | None = "masks",
        allow_outside: bool = False,
    ) -> None:
        settings = factor, max_width, test_every, cache_bytes, images_folder, model, masks, allow_outside
        super().__init__(partial(load_scene, root, *settings), seed, cache_bytes)
        self.root = Path(root).expanduser()

    def prepare_data(self) -> None:
        """Load the scene if this is the only process, so that an unusable folder fails before a run folder is made.

        Lightning calls this before its loggers create folders; with several processes, only one would fail here. It
        waits for the other ones where there is such a hook, so the base, which also serves one of several, has none.
        """
        if self.process == (0, 1):
            _ = self.scene


class DemoDataModule(ColmapDataModule):
    """The embedded demo scene: 40 photos of a small room, which the package contains.

    Args:
        root: Scene folder.
        **options: As of :class:`ColmapDataModule`.
    """

    def __init__(self, root: str = str(DEMO), **options: Any) -> None:
        super().__init__(root, **options)


@dataclass(eq=False)
class _TrainViews(IterableDataset[View]):
    """Train views in the sampler's order; a new iterator starts at the trainer's step."""

    data: SceneDataModule

    def __iter__(self) -> Iterator[View]:
        scene = self.data.scene
        if get_worker_info():
            raise ValueError("photos are decoded ahead here, and each worker would give all of them: set num_workers=0")
        order = view_order(len(scene.train), self.data.seed, *self.data.process, self.data.draw)
        for current, following in pairwise(order):
            scene.images.prefetch(scene.train[following])
            yield scene.view(scene.train[current])


@dataclass(eq=False)
class _OrderedViews(Dataset[View]):
    """Given views of a scene; each access starts decoding the one ``stride`` further on."""

    scene: Scene
    indices: Sequence[int]
    stride: int

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, position: int) -> View:
        following = position + self.stride
        if following < len(self):
            self.scene.images.prefetch(self.indices[following])
        return self.scene.view(self.indices[position])


def _summary(scene: Scene) -> str:
    """Size and split of a scene, and what of its photos does not count."""
    names = [scene.names[i] for i in scene.test]
    shown = ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:3])}, …, {names[-1]}"
    text = (
        f"{scene.root}: {len(scene)} views of {size_range(scene.cameras)}, "
        f"{len(scene.points)} points, extent {scene.extent:.3g}; "
        f"{len(scene.train)} train views, {len(scene.test)} test views ({scene.split}: {shown})"
    )
    if masked := sum(source.mask is not None for source in scene.images.sources):
        text += f"; {masked} views have a mask"
    if transparent := sum(source.has_alpha for source in scene.images.sources):
        text += f"; {transparent} may be transparent, which {'is white' if scene.white else 'does not count'}"
    return text
