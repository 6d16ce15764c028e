"""What a run has made of its scene so far: splats and codebooks, how they are rendered, and how they are stored."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nsvq_lightning.io.compressed import CompressedScene
from nsvq_lightning.io.placing import placed
from nsvq_lightning.quantize.attributes import attribute_rows, codes_of, decoded
from nsvq_lightning.quantize.codebook import Quantizer
from nsvq_lightning.rendering.camera import Camera
from nsvq_lightning.rendering.frame import Frame
from nsvq_lightning.rendering.rasterize import Render, render
from nsvq_lightning.splats.attributes import QUANTIZABLE, dropped, finite_rows
from nsvq_lightning.splats.conventions import Arrays, Float64s
from nsvq_lightning.splats.splats import RawSplats, Splats, SplatTensors, detached, sh_degree_of
from nsvq_lightning.top_level import log
from nsvq_lightning.training.schedule import Phase
from nsvq_lightning.version import __version__


@dataclass(frozen=True)
class SplatScene:
    """Splats in training, the codebooks that store them, and the settings that they are rendered with.

    Attributes:
        splats: The splats, in :attr:`frame`.
        quantizers: Quantizer by attribute; empty for a run without quantization.
        frame: Coordinates of the splats. Cameras that the scene is given, and files made of it, have those of the
            files.
        sh_degree: Degree that is rendered; higher coefficients are ignored.
        background: Behind the splats; ``random`` is black here.
        backend: Rasterizer, see :func:`nsvq_lightning.render`.
        cameras: Cameras of training ``[C, 4]`` that files keep, see :attr:`CompressedScene.cameras`.
    """

    splats: Splats
    quantizers: Mapping[str, Quantizer]
    frame: Frame
    sh_degree: int
    background: str
    antialiased: bool
    backend: str
    cameras: Float64s

    def rows(self, attribute: str) -> Tensor:
        """Rows ``[N, D]`` of a quantized attribute, detached."""
        return attribute_rows(self.splats.raw(), attribute)

    @torch.inference_mode(False)  # a quantizer may fit its codebook, which is trained afterwards
    @torch.no_grad()
    def hard_splats(self, phase: Phase) -> RawSplats:
        """The splats as a file written in ``phase`` would hold them, detached: hard codes from ``QUANTIZE`` on.

        They are still in :attr:`frame`.
        """
        raw = detached(self.splats)
        return decoded(raw, self.quantizers) if phase >= Phase.QUANTIZE else raw

    def render(self, splats: SplatTensors, camera: Camera, **options: Any) -> Render:
        """Render any splats as the scene's own.

        Args:
            splats: Raw attributes, in :attr:`frame`.
            camera: Where to look from, in the coordinates of the files.
            **options: Arguments of :func:`nsvq_lightning.render` that replace the scene's.
        """
        own = {
            "sh_degree": min(self.sh_degree, sh_degree_of(splats.shN)),
            "background": splats.means.new_ones(3) if self.background == "white" else None,
            "antialiased": self.antialiased,
            "backend": self.backend,
        }
        found = render(splats, self.frame.camera(camera), **(own | options))
        return found._replace(depth=self.frame.unit * found.depth)  # in units of the files, too

    def compressed(self, phase: Phase, settings: Mapping[str, Any]) -> CompressedScene:
        """The scene as it is stored: frozen or nearest codes, codebooks, positions, opacities and the settings.

        Before the quantize phase there are no codebooks yet, and everything is stored as it is.

        Args:
            phase: Phase of the run.
            settings: What else of the run the file tells; nothing that differs between two runs with the same seed.

        Raises:
            ValueError: There are no splats.
        """
        if len(self.splats) == 0:
            raise ValueError("there are no splats to store or to measure: pass the checkpoint of a run (--ckpt_path)")
        quantizers = self.quantizers if phase >= Phase.QUANTIZE else {}
        if self.quantizers and not quantizers:
            log.warning(f"the {phase.name.lower()} phase has no codebooks yet: the scene is stored unquantized")
        scene = to_compressed(self.splats.raw(), quantizers)  # PostHoc fits its codebooks only now
        told = {
            "version": __version__,
            "codebooks": {name: len(quantizer.codebook) for name, quantizer in quantizers.items()},
            "quantizers": {name: type(quantizer).__name__ for name, quantizer in quantizers.items()},
            "background": self.background,
            **settings,
        }
        if self.antialiased:
            told["antialiased"] = True
        return placed(scene, self.frame, config=told, cameras=self.cameras)


@torch.no_grad()
def to_compressed(splats: RawSplats, quantizers: Mapping[str, Quantizer]) -> CompressedScene:
    """The scene as it is stored: codes and codebooks where there are quantizers, plain float32 elsewhere.

    Splats with non-finite values are left out with a warning.

    Args:
        splats: Raw attributes.
        quantizers: Quantizer by attribute; empty stores everything as it is.

    Raises:
        ValueError: A codebook was never placed, or decodes to something else than its rows.
    """
    # Check before quantizing: the code of a row with NaN would be finite.
    finite, culprits = finite_rows(splats._asdict())
    codes = {name: codes_of(splats, name, quantizer) for name, quantizer in quantizers.items()}
    for name, quantizer in quantizers.items():
        some = codes[name][:1000]
        if not getattr(quantizer, "fitted", True):
            raise ValueError(f"the codebook of {name} has never been placed: add CodebookInit to the callbacks")
        if not torch.equal(quantizer.decode(some), quantizer.codebook[some]):
            raise ValueError(
                f"{type(quantizer).__name__} of {name} decodes to other rows than its codebook's, and files hold these"
            )
    scene = CompressedScene(
        means=_numpy(splats.means),
        opacities=_numpy(splats.opacities),
        codes={name: _numpy(found) for name, found in codes.items()},
        codebooks={name: _numpy(quantizer.codebook) for name, quantizer in quantizers.items()},
        raw={name: _numpy(attribute_rows(splats, name)) for name in QUANTIZABLE if name not in quantizers},
        sh_degree=sh_degree_of(splats.shN),
    )
    if not culprits:
        return scene
    log.warning(dropped(finite, culprits))
    return scene.take(_numpy(finite))


def _numpy(tensor: Tensor) -> Arrays:
    return tensor.numpy(force=True)
