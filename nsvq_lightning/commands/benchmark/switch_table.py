"""The table of switches in a document: what each skips, and the time it saves on each scene that was measured."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from nsvq_lightning.commands.benchmark.report import between, replace_between
from nsvq_lightning.commands.benchmark.row import Row
from nsvq_lightning.commands.benchmark.settings import Settings
from nsvq_lightning.skips import SKIPS

__all__ = ["PLACE", "fill_switches", "scene_name", "shares_saved", "turned_round"]

PLACE = "<!-- switches -->"
"""The line before the table; the one after it ends every table of a document."""

_HEAD = ("switch", "skips", "when", "result")
_SAVED = "saves on "


def turned_round(name: str) -> str:
    """What a run is called that differs from the shipped settings in the switch ``name``."""
    return f"{'no skip of' if SKIPS[name].default else 'skip'} {name}"


def scene_name(settings: Settings) -> str:
    """Name of the scene that whole runs train: the folder's, or that of the embedded one."""
    own = settings.scene is not None and settings.scene.is_dir()
    return settings.scene.resolve().name if own and settings.scene is not None else "demo"


def shares_saved(rows: Sequence[Row]) -> dict[str, float]:
    """Share of a run's time that each switch saves, from the rows of the suite ``train``; negative where it costs."""
    ratios = {row.method: row.values["times as shipped"] for row in rows if "times as shipped" in row.values}
    return {
        name: 1 - 1 / ratios[turned_round(name)] if skip.default else 1 - ratios[turned_round(name)]
        for name, skip in SKIPS.items()
        if turned_round(name) in ratios
    }


def fill_switches(document: str, scene: str = "", saved: Mapping[str, float] | None = None) -> str:
    """Write the table of all switches between the lines :data:`PLACE` and ``<!-- end -->``.

    Args:
        document: Markdown.
        scene: Scene that was measured; the columns of other scenes stay as they are.
        saved: Share of the time by switch, see :func:`shares_saved`; switches that are not in it keep their cell.

    Raises:
        ValueError: There is no such place.
    """
    columns = _columns(between(document, PLACE))
    if saved:
        columns.setdefault(scene, {}).update({name: f"{100 * share:.1f} %" for name, share in saved.items()})
    return replace_between(document, PLACE, "\n".join(_lines(columns)))


def _columns(table: str) -> dict[str, dict[str, str]]:
    """The cells by scene and switch that a table has."""
    rows = [[cell.strip() for cell in line.strip("| ").split("|")] for line in table.splitlines() if "|" in line]
    if not rows:
        return {}
    scenes = [name.removeprefix(_SAVED) for name in rows[0][len(_HEAD) :]]
    cells = {row[0].strip("`"): row[len(_HEAD) :] for row in rows[2:]}
    return {scene: {name: row[i] for name, row in cells.items()} for i, scene in enumerate(scenes)}


def _lines(columns: Mapping[str, Mapping[str, str]]) -> Iterator[str]:
    yield _line([*_HEAD, *(_SAVED + scene for scene in columns)])
    yield _line(["---"] * len(_HEAD) + ["--:"] * len(columns))
    for name, skip in SKIPS.items():
        result = skip.changes or "same bits"
        yield _line(
            [
                f"`{name}`",
                skip.work,
                skip.when,
                result if skip.default else f"{result}; off by default",
                *(column.get(name, "–") for column in columns.values()),
            ]
        )


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
