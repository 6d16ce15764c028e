"""Whether the kernels of a device compute what they should: each against the definition, on a tiny scene."""

import os

import torch
from torch import Tensor

from nsvq_lightning.compute.devices import fast_backends
from nsvq_lightning.compute.environment import came_late
from nsvq_lightning.compute.kernel_cache import kernel_folder
from nsvq_lightning.io.atomic import write_text
from nsvq_lightning.quality.loss import photometric_loss
from nsvq_lightning.quantize.kmeans import lookup
from nsvq_lightning.quantize.nearest import nearest, nearest_reference
from nsvq_lightning.quantize.nsvq import noise_substitution
from nsvq_lightning.random import generator
from nsvq_lightning.rendering.camera import camera_of
from nsvq_lightning.rendering.rasterize import render
from nsvq_lightning.splats.attributes import attribute_shapes
from nsvq_lightning.splats.splats import RawSplats
from nsvq_lightning.top_level import log
from nsvq_lightning.version import __version__

# Largest relative error of sound kernels: rounding stays below 1e-4, but a splat that crosses α = 1/255 costs more.
TOLERANCE = 1e-3


def relative_l2(value: Tensor, truth: Tensor) -> float:
    """‖value − truth‖ / ‖truth‖ in float64; the plain ‖value‖ where the truth is 0."""
    truth = truth.detach().double()
    distance, scale = (value.detach().double() - truth).norm(), truth.norm()
    return float(distance / scale if scale > 0 else distance)


def kernel_errors(device: str) -> dict[str, dict[str, float]]:
    """Relative L2 errors of image, loss, gradients and quantization by back-end, against plain torch in float64.

    A device whose only back-end is plain torch has none.
    """
    truth = _step("reference", "cpu", torch.float64)
    found = {}
    for backend in fast_backends(torch.empty(0, device=device)):
        step = _step(backend, device, torch.float32)
        found[backend] = {name: relative_l2(value.cpu(), truth[name]) for name, value in step.items()}
    return found


def _step(backend: str, device: str, dtype: torch.dtype) -> dict[str, Tensor]:
    """What a training step computes for 3000 random splats and 100 random codes."""
    draw = generator(0, 0, "self check")
    shapes = attribute_shapes(3).items()
    made = {name: torch.randn(3000, *shape, generator=draw, dtype=torch.float64) for name, shape in shapes}
    made["means"][:, 2] += 6
    made["scales"] -= 2.5
    photo, codebook = torch.rand(72, 96, 3, generator=draw), torch.randn(100, 4, generator=draw).to(device, dtype)
    splats = RawSplats(**{name: value.to(device, dtype).requires_grad_() for name, value in made.items()})
    image = render(splats, camera_of(torch.eye(4), (80, 80, 48, 36), 96, 72), backend=backend).image
    loss = photometric_loss(image, photo.to(device, dtype))
    loss.backward()  # type: ignore[no-untyped-call]
    quats, codebook = splats.quats.detach(), codebook.requires_grad_()
    codes = (nearest if dtype == torch.float32 else nearest_reference)(quats, codebook)
    found = lookup(codebook, codes)
    (found**2).sum().backward()  # type: ignore[no-untyped-call]
    substituted = noise_substitution(quats, codebook, codes, draw)
    return {
        "image": image,
        "loss": loss,
        **{name: tensor.grad for name, tensor in splats._asdict().items()},
        "codes": (quats - found).norm(dim=1),
        "noise": (substituted - quats).norm(dim=1),  # as long as the error
        "codebook": codebook.grad,
    }


def check_kernels(device: torch.device) -> None:
    """Check the kernels of a GPU when it is first used with these versions.

    Raises:
        RuntimeError: They compute something else.
    """
    name = f"{torch.cuda.get_device_name(device)}, nsvq_lightning {__version__}, torch {torch.__version__}"
    folder = kernel_folder()
    record = folder / "checked-devices.txt" if folder else None
    known = record.read_text(encoding="utf-8") if record and record.exists() else ""
    if name in known.splitlines():  # not in a part of one: 2.1 is in 2.13
        return
    for backend, errors in kernel_errors(str(device)).items():
        said = f"{backend} on {name}: relative errors of the kernels: " + written(errors)
        if not all(error < TOLERANCE for error in errors.values()):  # NaN is never below
            raise RuntimeError(
                f"{said}: this device computes wrong numbers; report this, and train with --trainer.accelerator=cpu"
            )
        log.info(said)
    if record:
        write_text(record, f"{known}{name}\n")


def written(errors: dict[str, float]) -> str:
    """Errors in one line."""
    return ", ".join(f"{name} {error:.1e}" for name, error in errors.items())


def check_device(device: torch.device) -> None:
    """Check the kernels of a GPU at its first use; on a CPU, warn of other processes that want the same cores."""
    if device.type == "cuda":
        check_kernels(device)
    elif came_late and torch.get_num_threads() > 1 and hasattr(os, "getloadavg") and os.getloadavg()[0] > 1.0:
        log.warning(
            "other processes also need the cores, and idle threads occupy them: a run may take twice as long; "
            "import nsvq_lightning before torch, or set OMP_WAIT_POLICY=passive"
        )
