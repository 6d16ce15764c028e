"""The schedule against the paper's own numbers (section 4.1), and against proportion."""

from __future__ import annotations

import pytest

from nsvq_lightning.training.schedule import Phase, Schedule


def test_the_papers_run_has_the_papers_phases() -> None:
    schedule = Schedule()
    assert schedule.ends == (15_000, 20_000, 43_000, 45_000)
    expected = {
        1: Phase.WARMUP,
        15_000: Phase.WARMUP,
        15_001: Phase.PRUNE,
        20_000: Phase.PRUNE,
        20_001: Phase.QUANTIZE,
        43_000: Phase.QUANTIZE,
        43_001: Phase.FINETUNE,
        45_000: Phase.FINETUNE,
    }
    assert {iteration: schedule.phase_at(iteration) for iteration in expected} == expected
    assert [schedule.first_of(phase) for phase in Phase] == [1, 15_001, 20_001, 43_001]


def test_the_papers_run_has_the_papers_milestones() -> None:
    schedule = Schedule()
    density = schedule.density_times(600, 14_900, 100)
    assert (density[0], density[1], density[-1], len(density)) == (600, 700, 14_900, 144)
    assert list(schedule.reset_times(12_000, 3000)) == [3000, 6000, 9000, 12_000]
    assert list(schedule.times(16_000, 20_000, 1000)) == [16_000, 17_000, 18_000, 19_000, 20_000]
    replaced = schedule.replacement_times(20_100, 22_000, 100, 43_000, 500)
    assert replaced == (*range(20_100, 22_001, 100), *range(22_500, 43_001, 500))
    assert schedule.refit_times(100) == tuple(range(20_100, 43_001, 100))
    assert [schedule.sh_degree_at(i, 1000, 3) for i in (1, 999, 1000, 1999, 2000, 3000, 45_000)] == [
        0,
        0,
        1,
        1,
        2,
        3,
        3,
    ]
    assert schedule.iteration(schedule.position_decay) == 30_000


def test_a_shorter_run_is_the_same_run_scaled() -> None:
    limits = dict.fromkeys(
        ("min_density_interval", "min_reset_interval", "min_replacement_interval", "min_finetune"), 1
    )
    schedule = Schedule(total=4500, **limits)
    assert schedule.ends == (1500, 2000, 4300, 4500)
    assert list(schedule.density_times(600, 14_900, 100))[:2] == [60, 70]
    assert list(schedule.reset_times(12_000, 3000)) == [300, 600, 900, 1200]
    assert list(schedule.times(16_000, 20_000, 1000)) == [1600, 1700, 1800, 1900, 2000]
    assert schedule.sh_degree_at(300, 1000, 3) == 3
    assert schedule.iteration(schedule.position_decay) == 3000


@pytest.mark.parametrize("total", [*range(100, 2000, 37), *range(2500, 50_000, 2500), 70_001])
def test_rounding_loses_none_of_a_series(total: int) -> None:
    """As a rounded interval would, added up: whoever prunes five times in the paper's run does so in any."""
    schedule = Schedule(total=total, min_reset_interval=1)
    for times, last in ((schedule.times(16_000, 20_000, 1000), 20_000), (schedule.reset_times(12_000, 3000), 12_000)):
        assert len(times) == {20_000: 5, 12_000: 4}[last]
        assert times[-1] == schedule.iteration(last)


@pytest.mark.parametrize("total", range(1, 6))
def test_codes_are_placed_before_they_are_tuned(total: int) -> None:
    for schedule in (Schedule(total=total), Schedule(total=total, warmup_end=0, prune_end=0)):
        assert schedule.first_of(Phase.QUANTIZE) is not None
        assert schedule.ends[-1] == total


def test_fine_tuning_of_short_runs_has_a_lower_limit_up_to_half_of_what_follows_pruning() -> None:
    assert Schedule(total=9000).ends == (3000, 4000, 8600, 9000)  # 400 are enough
    assert Schedule(total=1500).ends == (500, 667, 1200, 1500)
    assert Schedule(total=600).ends == (200, 267, 434, 600)
    assert Schedule(total=1500, reference_total=1500, warmup_end=500, prune_end=600, quantize_end=1400).ends[2] == 1400
    assert Schedule(total=1500, quantize_end=45_000).ends == (500, 667, 1500, 1500)


@pytest.mark.parametrize("total", range(4, 60))
def test_no_phase_vanishes_from_a_tiny_run(total: int) -> None:
    schedule = Schedule(total=total)
    ends = schedule.ends
    assert ends[-1] == total
    assert {schedule.phase_at(i) for i in range(1, total + 1)} == set(Phase)
    assert all(schedule.phase_at(end) is phase for phase, end in zip(Phase, ends, strict=True))


def test_equal_ends_leave_phases_out() -> None:
    plain = Schedule(total=3000, reference_total=30_000, prune_end=30_000, quantize_end=30_000)
    assert plain.ends == (1500, 3000, 3000, 3000)
    assert plain.first_of(Phase.QUANTIZE) is None
    assert plain.first_of(Phase.FINETUNE) is None
    assert plain.phase_at(3000) is Phase.PRUNE
    assert plain.phase_at(3001) is Phase.PRUNE


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"total": 0}, "total=0"),
        ({"warmup_end": 30_000}, "phase ends must satisfy"),
        ({"quantize_end": 50_000}, "phase ends must satisfy"),
        ({"quantize_end": 20_000}, "quantize phase of at least one iteration"),
        ({"total": 4500, "saved": 1500}, "a run cannot save 1500 iterations of its warm-up phase"),
        ({"min_density_interval": 0}, "min_density_interval must be at least 1"),
    ],
)
def test_impossible_schedules_are_refused(settings: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Schedule(**settings)


def test_what_the_warm_up_saves_moves_all_that_follows() -> None:
    whole, shorter = Schedule(total=4500), Schedule(total=4500, saved=300)
    assert shorter.ends == tuple(end - 300 for end in whole.ends)
    assert shorter.iteration(12_000) == whole.iteration(12_000)
    assert shorter.iteration(18_500) == whole.iteration(18_500) - 300
    assert shorter.times(16_000, 20_000, 1000) == tuple(time - 300 for time in whole.times(16_000, 20_000, 1000))
    assert shorter.refit_times(500) == tuple(time - 300 for time in whole.refit_times(500))
    replaced = whole.replacement_times(20_100, 22_000, 100, 40_000, 500)
    assert shorter.replacement_times(20_100, 22_000, 100, 40_000, 500) == tuple(time - 300 for time in replaced)
    assert [shorter.sh_degree_at(iteration, 1000, 3) for iteration in (99, 100, 300)] == [0, 1, 3]
