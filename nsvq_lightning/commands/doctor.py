"""Check whether this machine is fit for training, and whether a folder is a good scene.

Each line is good, a note (works, could be better or faster) or a problem (a run would fail, or miss something).

Examples:
  nsvq doctor
  nsvq doctor path/to/scene
  nsvq doctor path/to/scene > doctor.txt
"""

import os
import platform
import re
import shutil
from argparse import ArgumentParser, Namespace
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from nsvq_lightning.commands import say
from nsvq_lightning.commands.settings import check_config, find_config
from nsvq_lightning.top_level import log

# Each check imports what it needs: --help answers at once, and a package that is missing or broken fails only the
# checks that need it.
if TYPE_CHECKING:
    from nsvq_lightning.data.colmap import ColmapModel
    from nsvq_lightning.data.scene import Scene


def add_arguments(parser: ArgumentParser) -> None:
    """Add what ``nsvq doctor`` takes."""
    parser.add_argument("folder", nargs="?", type=Path, metavar="FOLDER", help="scene folder to check")


def run(options: Namespace) -> int:
    """Check this machine and, if given, a scene folder.

    Returns:
        0, or 1 if there is a problem: the self-test fails or the folder cannot be used.
    """
    log.setLevel("WARNING")
    counts = shown(check_all(options.folder))
    problems, notes = counts["problem"], counts["note"]
    say(f"\n{problems or 'no'} problem{'s' * (problems != 1)}, {notes or 'no'} note{'s' * (notes != 1)}")
    return 1 if problems else 0


def shown(findings: "Findings") -> Counter[str]:
    """Print findings as they come, since each check takes seconds; returns how many there are of each verdict."""
    counts = Counter[str]()
    for finding in findings:
        say(str(finding))
        counts[finding.verdict] += 1
    return counts


def check_all(folder: Path | None) -> "Findings":
    """All findings about this machine and, if given, a scene folder."""
    yield from attempt("machine", check_machine())
    yield from attempt("packages", check_packages())
    yield from attempt("threads", check_threads())
    yield from attempt("memory", check_room(Path()))
    yield from attempt("self-test", check_backends())
    if folder:
        yield from check_folder(folder)


class Finding(NamedTuple):
    """One line of the doctor's report.

    Attributes:
        verdict: ``good``; ``note`` for what costs quality or time; ``problem`` for what keeps a run from working.
        subject: What was checked, one or two words.
        text: What was found and, unless it is good, what would help.
    """

    verdict: Literal["good", "note", "problem"]
    subject: str
    text: str

    def __str__(self) -> str:
        return f"{self.verdict:<8} {self.subject:<12} {self.text}"


# What a check finds, as it goes on.
Findings = Iterator[Finding]


def judged(subject: str, text: str, advice: str, *, when: bool) -> Finding:
    """A note with the advice when something is not as it should be, otherwise good."""
    return Finding("note", subject, f"{text}: {advice}") if when else Finding("good", subject, text)


def attempt(subject: str, check: Findings) -> Findings:
    """The findings of a check; if it raises, that is one more, and the other checks can still be made."""
    try:
        yield from check
    except Exception as error:  # third-party code may fail in any way on this machine or folder
        text = " ".join(str(error).split())
        # That of a bad file says what is wrong and where.
        ours = isinstance(error, ValueError | OSError)
        yield Finding("problem", subject, text if ours else f"the check itself failed: {type(error).__name__}: {text}")


def check_machine() -> Findings:
    """The machine, and the versions of Python and of the packages that results depend on."""
    import torch

    from nsvq_lightning.commands.benchmark import timing
    from nsvq_lightning.compute.devices import best_device

    machine, versions = timing.describe_machine()
    if torch.cuda.is_available() or torch.backends.mps.is_available():
        advice = "runs use the CPU, as its GPU has no kernels here (NVIDIA's have, on Linux with Triton 3.4 or later)"
    else:
        advice = "torch finds no GPU: one of NVIDIA needs a CUDA build, and must be seen by nvidia-smi"
    yield judged("machine", machine, advice, when=best_device().type == "cpu")
    yield Finding("good", "versions", versions)


OPENCV = "opencv-contrib-python-headless"


def check_packages() -> Findings:
    """OpenCV, once: several packages overwrite each other's files."""
    try:
        from cv2 import __version__ as found  # which the folder that an uninstalled package leaves has not
    except ImportError as error:
        advice = f"pip install {OPENCV} --force-reinstall --no-deps"
        yield Finding("problem", "opencv", f"cannot be loaded ({error}): {advice}")
        return
    packages = sorted(set(packages_distributions().get("cv2", ())))
    text = f"{found} ({' and '.join(packages) or 'not from pip'})"
    advice = f"they overwrite each other's files; uninstall all of them, then pip install {OPENCV}"
    yield judged("opencv", text, advice, when=len(packages) > 1)


def check_threads() -> Findings:
    """Whether the kernels use all cores."""
    import numba
    import torch

    from nsvq_lightning.compute.environment import usable_cores
    from nsvq_lightning.compute.jit import thread_count

    cores = usable_cores()
    used = thread_count()
    told = {"OMP_NUM_THREADS", "NUMBA_NUM_THREADS"} & os.environ.keys()
    # On a Mac, torch spares the slow cores, which would hold up the others.
    spared = used < cores and not told and (platform.system(), platform.machine()) == ("Darwin", "arm64")
    text = f"{used} used of {cores} cores (torch {torch.get_num_threads()}, numba {numba.config.NUMBA_NUM_THREADS})"
    advice = f"as many as cores are fastest; unset OMP_NUM_THREADS and NUMBA_NUM_THREADS, or set them to {cores}"
    yield judged("threads", text, advice, when=used != cores and not spared)


# Bytes; less may not hold checkpoints and report.
MIN_DISK = 2 << 30


def check_room(folder: Path) -> Findings:
    """Memory for a run, and disk space for checkpoints, report and exports where runs are written."""
    free = available_memory()
    text = "not told by this system" if free is None else f"{free / 1e9:.1f} GB available"
    advice = "a usual run takes 2 to 4 GB; end programs, or try --data.max_width 800 --data.cache_bytes 500000000"
    yield judged("memory", text, advice, when=free is not None and free < 4 << 30)
    disk = shutil.disk_usage(folder).free
    writable = os.access(folder, os.W_OK)
    text = f"{disk / 1e9:.1f} GB free in {folder.resolve()}{'' if writable else ', which is read-only'}"
    advice = "checkpoints of a run take about 1 GB; see --trainer.default_root_dir"
    found = judged("disk", text, advice, when=disk < MIN_DISK or not writable)
    yield found if writable else found._replace(verdict="problem")


def check_backends() -> Findings:
    """Every usable back-end against plain torch in float64, which takes seconds."""
    from nsvq_lightning.compute.devices import devices_with_kernels
    from nsvq_lightning.compute.kernel_cache import kernel_folder
    from nsvq_lightning.training.self_check import TOLERANCE, kernel_errors, written

    for device in devices_with_kernels():
        for backend, errors in kernel_errors(device).items():
            text = f"{backend}: relative errors against float64: {written(errors)}"
            if all(error < TOLERANCE for error in errors.values()):
                yield Finding("good", "self-test", text)
                continue
            advice = f"do not trust a run; remove {kernel_folder()}, and if that does not help report it with "
            yield Finding("problem", "self-test", f"{text}: {advice}what nsvq doctor says")


def check_folder(root: Path) -> Findings:
    """All findings about a scene folder; an unusable folder is a finding, not an exception."""
    yield from attempt("model", check_model(root))


def check_model(root: Path) -> Findings:
    """Read the model, then check it, and the scene that it makes."""
    from nsvq_lightning.data.colmap import larger_models
    from nsvq_lightning.data.transforms import read_poses

    model = read_poses(root, observations=True)
    if model.source == "COLMAP" and (larger := larger_models(root)):
        yield Finding("problem", "model", larger)
    yield from attempt("cameras", check_cameras(model))
    yield from attempt("points", check_points(model))
    yield from attempt("overlap", check_overlap(model))
    yield from attempt("scene", check_scene(root, model))


def check_cameras(model: "ColmapModel") -> Findings:
    """Number, models and sizes of the cameras, and what distortion does to the corners."""
    from nsvq_lightning.data.colmap import size_range

    photos = len(model.images)
    cameras = model.cameras.values()
    sizes = {(camera.width, camera.height) for camera in cameras}
    names = sorted({camera.model_name for camera in cameras})
    text = f"{len(cameras)} of {'/'.join(names)}, {size_range(cameras)}, for {photos} registered photos"
    advice = "more exact if one lens took them and COLMAP knows it (--ImageReader.single_camera 1)"
    many = len(cameras) > max(1, photos // 2) and len(sizes) <= 2
    yield judged("cameras", text, advice, when=model.source == "COLMAP" and many)


def check_points(model: "ColmapModel") -> Findings:
    """Number of points, and outliers."""
    from nsvq_lightning.data.scene import astray

    count = len(model.points)
    if not count:
        text = f"none in {model.source}: what photos have in common takes their place, and training has more to do"
        advice = "name a point cloud (ply_file_path in the file), or run COLMAP"
        yield judged("points", text, advice, when=not model.synthetic)
        return
    finite = model.points[np.isfinite(model.points).all(1)]
    if not len(finite):
        yield Finding("problem", "points", f"none of {count:,} is finite: export the model again")
        return
    far = astray(finite, 10).mean()
    text = f"{count:,}{'' if np.ptp(model.colors) else ', without colours'}, {100 * far:.2g} % far outliers"
    if len(finite) < count:
        text += f", {count - len(finite)} not finite (left out)"
    if count < 1000:
        advice = "few to start from; take more photos with more overlap, or match more features"
    else:
        advice = "they become floaters; filter them with `colmap point_filtering`"
    yield judged("points", text, advice, when=count < 1000 or far > 0.02)


def check_overlap(model: "ColmapModel") -> Findings:
    """Whether each view shares points with another, and all are connected."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    from nsvq_lightning.data.reconstruct import some

    pairs = model.observations
    if pairs is None or not len(pairs):
        yield Finding("note", "overlap", f"{model.source} has no observations: how far views overlap is unknown")
        return
    names = [image.name for image in model.images]
    seen = csr_array((np.ones(len(pairs), np.int64), pairs.T), shape=(len(model.points), len(names)))
    common = (seen.T @ seen).toarray()  # points that two views both saw [V, V]; on the diagonal, those of one view
    own = np.maximum(common.diagonal(), 1)
    np.fill_diagonal(common, 0)
    best = common.max(axis=1) / own
    groups, group_of = connected_components(common >= 15, directed=False)
    weak = np.flatnonzero(group_of != np.bincount(group_of).argmax() if groups > 1 else best < 0.3)
    named = some([names[i] for i in weak], 3)
    usual, least = 100 * np.median(best), 100 * best.min()
    text = f"a photo shares {usual:.0f} % of its points with its best partner, at least {least:.0f} %"
    advice = f"little for {named}; take photos in between"
    if groups > 1:
        advice = f"under 15 with the rest for {named}; take photos between them, or leave them out"
    yield judged("overlap", text, advice, when=len(weak) > 0)


def check_scene(root: Path, model: "ColmapModel") -> Findings:
    """Load the folder as a run does it, then check its split, its photos and their shape, and what a run will take."""
    from nsvq_lightning.data.images import is_cut
    from nsvq_lightning.data.points import in_picture
    from nsvq_lightning.data.scene import ONE_PLACE, OTHER_SHAPE, load_scene, spread

    scene = load_scene(root)
    train, test = len(scene.train), len(scene.test)
    text = f"{train} train and {test} test photos ({scene.split})"
    advice = "few; what lies between them is guessed, and the test score says little; take more photos"
    yield judged("split", text, advice, when=train < 20)
    if not scene.extent > 0:
        yield Finding("problem", "extent", f"all train photos {ONE_PLACE}")
    if (seen := model.observations) is not None:
        points, seen = model.points - scene.frame.origin, spread(seen, 20_000)
        shown = sum(
            np.count_nonzero(in_picture(points[seen[seen[:, 1] == row, 0]], camera))
            for row, camera in enumerate(scene.cameras)
        )
        if 2 * shown < len(seen):
            text = f"{1 - shown / len(seen):.0%} of the points are not in the pictures that they were found in"
            yield Finding("problem", "poses", f"{text}: are poses camera to world, or quaternions xyzw?")
    pairs = zip((model.cameras[image.camera_id] for image in model.images), scene.images.sources, strict=True)
    if others := sum(is_cut(source.size, (camera.width, camera.height)) for camera, source in pairs):
        yield Finding("problem", "sizes", f"{others} of {len(scene)} files {OTHER_SHAPE}")
    yield from attempt("photos", check_photos(scene, model))
    yield from attempt("still", check_still(scene))
    yield from attempt("run time", check_budget(scene))


def check_photos(scene: "Scene", model: "ColmapModel") -> Findings:
    """Decode all photos, in parallel: whether that works, how much masks exclude, and which are not in the model."""
    from nsvq_lightning.data.photo_files import photos_below
    from nsvq_lightning.data.scene import ELSEWHERE, each_photo, is_elsewhere, uneven

    # Share of the pixels that count, or what is wrong.
    found = each_photo(scene, lambda photo: 1.0 if photo.mask is None else float(photo.mask.float().mean()))
    shares = {name: share for name, share in zip(scene.names, found, strict=True) if isinstance(share, float)}
    count = len(scene)
    if len(shares) < count:
        first = next(each for each in found if not isinstance(each, float))
        yield Finding("problem", "photos", f"{count - len(shares)} of {count} cannot be used; first: {first}")
    else:
        yield Finding("good", "photos", f"all {count} registered photos can be read")
        if is_elsewhere(scene):
            yield Finding("problem", "points", f"they {ELSEWHERE}")
        elif remark := uneven(scene):
            yield Finding("note", "exposures", f"photos {remark}")
    if masked := {name: share for name, share in shares.items() if share < 1}:
        left_out = 1 - sum(masked.values()) / len(masked)
        text = f"{len(masked)} of {count} photos have pixels that do not count, {100 * left_out:.0f} % of them"
        most = min(masked, key=masked.__getitem__)
        advice = f"most in {most}; masks are white where the photo counts; if not, invert them"
        yield judged("masks", text, advice, when=left_out > 0.7)
    folder = scene.root / (model.images_folder or "images")
    if folder == scene.root.absolute():
        return  # that of a NeRF-synthetic scene, which also holds maps and further views
    files = photos_below(folder)
    if extra := set(files).difference(source.path for source in scene.images.sources):
        text = f"{len(extra)} of {len(files)} files in {folder} are not in the model"
        advice = "they are not used; if many, photos lack overlap or sharpness"
        yield Finding("note", "registered", f"{text}: {advice}")


def check_still(scene: "Scene") -> Findings:
    """Whether pixels are the same in most photos: bars, or the background of a turntable."""
    from nsvq_lightning.data.scene import spread

    photos = [scene.images[index] for index in spread(scene.train, 32)]
    plain = [image[::4, ::4] for image, mask in photos if mask is None and image.shape == photos[0].image.shape]
    if len(plain) < 5 or scene.white:
        return
    shown = np.stack(plain).astype(np.float32)
    share = (np.median(abs(shown - np.median(shown, 0)), 0) < 0.03 * shown.std()).mean()
    if share > 0.03:
        text = f"{100 * share:.0f} % of the pixels are the same in most photos"
        yield Finding("note", "still", f"{text}, as bars and the background of a turntable are: mask them")


def check_budget(scene: "Scene") -> Findings:
    """Time of a run, from steps with the splats of ``fast.yaml``."""
    from nsvq_lightning.callbacks import BudgetedGrowth, PhaseSchedule, SplatBudget
    from nsvq_lightning.callbacks.forecast import iteration_seconds
    from nsvq_lightning.callbacks.growth import splats_for_photos
    from nsvq_lightning.compute.devices import best_device
    from nsvq_lightning.data.scene import detailed_pixels, stretch

    fast = check_config(find_config("fast"))
    phases = PhaseSchedule(**fast["callbacks"]["phases"])
    wanted = SplatBudget(**fast["callbacks"]["budget"])
    budget = splats_for_photos(len(scene.train), detailed_pixels(scene), wanted.quality * stretch(scene))
    steps = phases.limited(fast["trainer"]["max_steps"], len(scene.train))
    parts = BudgetedGrowth().stretches(phases.schedule(steps), round(wanted.start * budget), budget)
    minutes = steps * iteration_seconds(scene, parts, best_device()) / 60
    yield Finding("good", "run time", f"about {minutes:.0f} min for fast.yaml, on a machine as busy as now")


def available_memory() -> int | None:
    """Bytes that this process may still allocate: of the machine, or of its control group if less; None if not told."""
    limits = []
    with suppress(OSError):
        told = Path("/proc/meminfo").read_text(encoding="ascii")
        limits += [1024 * int(number) for number in re.findall(r"^MemAvailable:\s+(\d+)", told, re.MULTILINE)]
    group = Path("/sys/fs/cgroup")
    with suppress(OSError, ValueError):  # "max" is no number, and no limit
        limit, used, facts = ((group / f"memory.{name}").read_bytes() for name in ("max", "current", "stat"))
        cached = sum(map(int, re.findall(rb"^inactive_file (\d+)", facts, re.MULTILINE)))  # which may go
        limits.append(max(0, int(limit) - int(used) + cached))
    return min(limits, default=None)
