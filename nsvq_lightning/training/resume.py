"""Checkpoints that continue a run: read, checked, and never trusted to import anything."""

import re
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import asdict, is_dataclass, replace
from hashlib import sha256
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor

from nsvq_lightning.data.scene import Scene
from nsvq_lightning.io.atomic import StrPath, make_folder_of, write_bytes
from nsvq_lightning.io.errors import FormatError, Json
from nsvq_lightning.splats.splats import sh_degree_of
from nsvq_lightning.top_level import join, log
from nsvq_lightning.training.schedule import Schedule

# Of a checkpoint, or of a part of one, by their names.
Values = Mapping[str, Any]

# Key under which a checkpoint holds the class and number of codes that each quantizer was made with.
QUANTIZER_SETTINGS = "quantizer_settings"
WAY_OUT = "pass a checkpoint that nsvq fit has written, …/checkpoints/last.ckpt"


def continued_schedule(checkpoint: Values, schedule: Schedule) -> Schedule:
    """The schedule with the iterations that the checkpoint's run has saved in the same warm-up phase.

    Raises:
        ValueError: The checkpoint holds only weights.
    """
    if not checkpoint.get("optimizer_states"):
        raise ValueError(
            "the checkpoint holds weights without the state of the optimiser, so training cannot continue from it; "
            "export its scene and start from that (--model.init_from=scene.ply)"
        )
    stored = Schedule(**checkpoint["schedule"])
    same = all(getattr(stored, name) == getattr(schedule, name) for name in ("total", "reference_total", "warmup_end"))
    return replace(schedule, saved=stored.saved) if same else schedule


def changes(checkpoint: Values, schedule: Schedule, own: Values) -> str:
    """Options by which a run with another schedule and other settings of the module goes on as that of a checkpoint."""
    trained = checkpoint.get("hyper_parameters", {})
    kinds = ("callbacks.phases", checkpoint["schedule"], asdict(schedule)), ("model", trained, plain(own))
    changed = [
        f"--{kind}.{name}={'null' if value is None else value}"
        for kind, stored, here in kinds
        for name, value in stored.items()
        if here.get(name, value) != value and name not in ("saved", "init_from")
    ]
    return join(changed).replace("callbacks.phases.total", "trainer.max_steps")


def check_continuation(checkpoint: Values, own: Mapping[str, Tensor], quantizers: Mapping[str, Values]) -> None:
    """Check that a module can have the splats and codebooks of a checkpoint.

    Args:
        checkpoint: The checkpoint, as it was read.
        own: Its ``state_dict()``; numbers of splats may differ, and those of codes if k-means found fewer rows.
        quantizers: Class and number of codes of the module's quantizers by attribute, as requested.

    Raises:
        ValueError: It is of a module with other settings.
    """
    stored, here = (sh_degree_of(values["splats.shN"]) for values in (checkpoint["state_dict"], own))
    if stored != here:
        raise ValueError(f"the checkpoint has SH degree {stored}, this run {here}; pass --model.sh_degree={stored}")
    trained = checkpoint[QUANTIZER_SETTINGS]
    if trained != quantizers:
        raise ValueError(
            f"the checkpoint is of a run that quantizes with {_described(trained)}, and this one would with "
            f"{_described(quantizers)}; pass the --model.quantizer and --model.codebooks that it was trained with"
        )


def _described(settings: Mapping[str, Values]) -> str:
    """The quantizers of a run, for a message."""
    kinds = ", ".join(sorted({str(one["quantizer"]) for one in settings.values()}))
    sizes = ", ".join(f"{name}: {one['codes']}" for name, one in settings.items())
    return f"{kinds} ({sizes})" if settings else "no codebooks"


# Key under which a checkpoint holds which scene it is of.
SCENE = "scene"


def read_checkpoint(path: StrPath) -> dict[str, Any]:
    """Read a checkpoint of this package onto the CPU.

    Raises:
        FileNotFoundError: No such file.
        PermissionError: The file is not readable.
        FormatError: The file is damaged or truncated, holds more than tensors and plain data, or is not a checkpoint of
            a :class:`nsvq_lightning.SplatModule`.
    """
    checkpoint = _plain_content(Path(path))
    _check_contents(path, checkpoint)
    return checkpoint  # type: ignore[no-any-return]  # checked


def _plain_content(path: Path) -> Any:
    """What a file of torch holds; raises as :func:`read_checkpoint` does where that is damaged or more than data."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such checkpoint; {WAY_OUT}")
    try:
        with ZipFile(path) as archive:  # torch itself does not verify its checksums
            damaged = archive.testzip()
        if damaged is not None:
            raise FormatError(f"{path}: damaged, its part {damaged} is not what was written", WAY_OUT)
        return torch.load(path, map_location="cpu", weights_only=True)
    except (PermissionError, FormatError):
        raise
    except BadZipFile as error:
        raise FormatError(f"{path}: truncated, or not a checkpoint", WAY_OUT) from error
    except UnpicklingError as error:
        found = _named(error)
        raise FormatError(f"{path}: refused, it holds {found}, and loading that could run code", WAY_OUT) from error
    except Exception as error:  # damage can make torch's archive and pickle readers raise anything
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise FormatError(f"{path}: damaged, or not a checkpoint ({reason})", WAY_OUT) from error


def _named(error: UnpicklingError) -> str:
    named = re.search(r"GLOBAL (\S+)", str(error))
    return f"an object of {named[1]}" if named else "an object that is not plain data"


def _check_contents(path: StrPath, checkpoint: Any) -> None:
    state = checkpoint.get("state_dict") if isinstance(checkpoint, dict) else None
    if not isinstance(state, dict) or "pytorch-lightning_version" not in checkpoint:
        raise FormatError(f"{path}: not a checkpoint of Lightning", WAY_OUT)
    if not {"splats.means", "_extra_state"} <= state.keys():
        first = ", ".join(list(state)[:3]) or "nothing"
        raise FormatError(f"{path}: a checkpoint of another model, which has {first} but no splats", WAY_OUT)
    if missing := {"history", "schedule", QUANTIZER_SETTINGS} - checkpoint.keys():
        raise FormatError(f"{path}: a checkpoint of another version, without {', '.join(sorted(missing))}", WAY_OUT)


def check_settings(path: Any, settings: Values, named: Collection[str] = ()) -> None:
    """Check that making a module from the settings of a checkpoint imports nothing.

    The parser would import whatever they name. What is named by the user, on the command line or in Python, has been
    imported before.

    Args:
        path: The checkpoint, for messages.
        settings: Its hyper-parameters.
        named: Texts on the command line.

    Raises:
        FormatError: They name something that has not been imported, or that was not made to be named.
    """
    if settings.get("_instantiator") not in (None, "lightning.pytorch.cli.instantiate_module"):
        raise FormatError(f"{path}: refused, it names the function {settings['_instantiator']}", WAY_OUT)
    only_text = ("init_from", "codebooks", "_instantiator")  # the last has been checked
    for option, text in _texts("model", {k: v for k, v in settings.items() if k not in only_text}):
        if text not in named and not _is_harmless(text):
            raise FormatError(
                f"{path}: refused, its {option} is {text}, and a checkpoint may not import what it names",
                f"if you trust that code, name it: --{option}={text}, or import it first in Python",
            )


def _texts(option: str, value: Any) -> Iterator[tuple[str, str]]:
    """All texts among settings, each with the command-line option that sets it."""
    if isinstance(value, str):
        yield option, value
    elif isinstance(value, Mapping | list | tuple):
        for key, part in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from _texts(option if key in ("class_path", "init_args") else f"{option}.{key}", part)


def _is_harmless(text: str) -> bool:
    """Whether a text is a plain word, or the name of something that has been imported from where it was defined."""
    if re.fullmatch(r"[\w+-]*", text):
        return not Path(text).is_file()  # the parser would read settings from it
    root, _, rest = text.partition(".")
    try:
        found = attrgetter(rest)(sys.modules[root])
    except (KeyError, AttributeError):
        return False
    # Else torch.os.system would be part of torch.
    return root not in sys.stdlib_module_names and str(getattr(found, "__module__", "")).partition(".")[0] == root


def scene_record(scene: Scene) -> Json:
    """What a checkpoint remembers of its scene: the folder's name, poses, and how it was read.

    A digest of the pose of each view by name depends neither on the place of the folder nor on how it was read: the
    width of the first picture and the names of the test views.
    """
    digests = {}
    for name, camera in zip(scene.names, scene.cameras, strict=True):
        rotation, centre = camera.packed_view[:9], np.array(camera.packed_view[12:]) + scene.frame.origin
        pose = [*(round(value, 4) + 0.0 for value in rotation), f"{np.linalg.norm(centre):.3e}"]
        digests[name] = sha256(repr(pose).encode()).hexdigest()[:8]
    read = [scene.cameras[0].width, *(scene.names[index] for index in scene.test)]
    return {"folder": scene.root.resolve().name, "views": digests, "read": read}


def check_scene(checkpoint: Values, scene: Scene) -> None:
    """Check that a checkpoint is of a scene: most views that both have are seen from the same place.

    Raises:
        ValueError: It is of another one.
    """
    stored, own = checkpoint[SCENE], scene_record(scene)
    common = stored["views"].keys() & own["views"].keys()
    same = sum(stored["views"][name] == own["views"][name] for name in common)
    if not common or 2 * same < len(common):  # not all: rounding may turn out otherwise
        raise ValueError(
            f"the checkpoint is of another scene: it was trained on {stored['folder']} with {len(stored['views'])} "
            f"views, and {same} of the {len(scene)} views of {scene.root} are among them with the same pose; pass "
            "--data.root with the folder it was trained on, or --trainer.allow_other_scene=true if that is meant"
        )
    if stored["views"].keys() != own["views"].keys() or stored.get("read", own["read"]) != own["read"]:
        log.warning(f"{scene.root} has other photos, sizes or test views than the run so far: it may have seen these")


class PlainCheckpointIO(TorchCheckpointIO):
    """Lightning's reading and writing of checkpoints; local files with :func:`read_checkpoint` and in their folder."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a checkpoint in one step; Lightning first writes it where the system has temporary files.

        Raises:
            ValueError: A callback's state is more than tensors and plain data, so that no run could read it.
        """
        if "://" in str(path):
            super().save_checkpoint(checkpoint, path, storage_options)
            return
        content, states = BytesIO(), BytesIO()  # straight into the file, torch would hide that a disk is full
        torch.save(checkpoint, content)
        torch.save(checkpoint.get("callbacks"), states)
        states.seek(0)
        try:
            torch.load(states, weights_only=True)
        except UnpicklingError as error:
            raise ValueError(f"a callback keeps {_named(error)}, which no run could read: make it a tensor") from error
        make_folder_of(Path(path))
        write_bytes(path, content.getvalue())

    def load_checkpoint(self, path: str | Path, map_location: Any = None, weights_only: bool | None = None) -> Any:
        """Read a checkpoint; remote ones as Lightning does, but also refusing anything that could run code.

        Raises:
            FormatError: See :func:`read_checkpoint`.
        """
        if "://" in str(path):
            return super().load_checkpoint(path, weights_only=True)
        content = _plain_content(Path(path))
        if not (isinstance(content, dict) and "splats.means" in content):
            _check_contents(path, content)
        return content  # of processes started from a notebook, the first hands back the weights alone


def plain(values: Values) -> dict[str, Any]:
    """The entries that are plain data; dataclasses become dictionaries, everything else is left out.

    An object in a checkpoint would make it unreadable without executing code. LightningCLI records classes as
    ``class_path`` and ``init_args``, which are plain; a class given from Python must be given again at loading.
    """
    converted = {name: asdict(v) if is_dataclass(v) and not isinstance(v, type) else v for name, v in values.items()}
    return {name: value for name, value in converted.items() if _is_plain(value)}


def _is_plain(value: Any) -> bool:
    if type(value) is dict:
        return all(isinstance(key, str) and _is_plain(item) for key, item in value.items())
    if type(value) in (list, tuple):
        return all(_is_plain(item) for item in value)
    # Exact types: an enum member or NumPy scalar is also an int or float, but not to the unpickler.
    return value is None or type(value) in (bool, int, float, str)
