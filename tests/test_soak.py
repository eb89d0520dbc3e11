"""A short version of the soak benchmark."""
from collections.abc import Sequence

from bench.bench_soak import RECOVERY_S, Soak
import pytest

from ps_head_driver import sequence
from ps_head_driver.cameras.base import Frame
from ps_head_driver.stack import Light


def test_random_faults_publish_no_wrong_stack() -> None:
    outcome = Soak(seed=2).run(150)
    assert outcome.captures == 150
    assert 100 < outcome.published < 150
    assert outcome.wrong == 0
    assert len(outcome.refused) >= 4
    assert outcome.longest_outage < RECOVERY_S


def test_the_soak_notices_a_match_by_order_of_arrival(monkeypatch: pytest.MonkeyPatch) -> None:
    def by_arrival(frames: Sequence[Frame], lights: Sequence[Light], _: float) -> list[Frame]:
        return [frames[i % len(frames)] for i in range(len(lights))]

    monkeypatch.setattr(sequence, 'match', by_arrival)
    assert Soak(seed=2).run(150).wrong > 0
