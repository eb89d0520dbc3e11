"""Places, drops and waits of the reconstruction pipeline, without ROS."""
import threading
import time
from types import SimpleNamespace

import pytest

from ps_head_driver.errors import ErrorCode, PsError
from ps_inspection.stack_pipeline import StackPipeline


def never() -> bool:
    return False


def always() -> bool:
    return True


def info(stack_id: str) -> SimpleNamespace:
    return SimpleNamespace(stack_id=stack_id)


def code_of(call: object) -> ErrorCode:
    with pytest.raises(PsError) as error:
        call()      # type: ignore[operator]
    return error.value.code


def test_result_that_came_before_the_wait():
    pipeline = StackPipeline(2)
    pipeline.acquired('a')
    pipeline.reconstructed(info('a'))
    assert pipeline.wait('a', 1.0, never, always).stack_id == 'a'


def test_results_in_another_order_reach_their_inspections():
    pipeline = StackPipeline(2)
    pipeline.acquired('a')
    pipeline.acquired('b')
    pipeline.reconstructed(info('a'))
    pipeline.reconstructed(info('b'))
    assert pipeline.wait('b', 1.0, never, always).stack_id == 'b'
    assert pipeline.wait('a', 1.0, never, always).stack_id == 'a'


def test_stack_overtaken_by_a_newer_one_was_dropped():
    pipeline = StackPipeline(2)
    for stack_id in ('ours', 'waiting', 'of others'):
        pipeline.acquired(stack_id)
    pipeline.reconstructed(info('of others'))
    assert code_of(lambda: pipeline.wait('ours', 5.0, never, always)) == \
        ErrorCode.INSPECTION_STACK_DROPPED
    assert pipeline.dropped == 1


def test_no_result_and_no_node_are_errors():
    pipeline = StackPipeline(2)
    pipeline.acquired('a')
    for timeout, alive in ((0.1, always), (60.0, never)):
        begin = time.monotonic()
        assert code_of(lambda: pipeline.wait('a', timeout, never, alive)) == \
            ErrorCode.INSPECTION_RECONSTRUCTION_LOST      # noqa: B023
        assert time.monotonic() - begin < 2.0


def test_third_stack_waits_for_a_place():
    pipeline, entered = StackPipeline(2), threading.Event()

    def third() -> None:
        with pipeline.place(never):
            entered.set()

    with pipeline.place(never):
        with pipeline.place(never):
            thread = threading.Thread(target=third)
            thread.start()
            assert not entered.wait(0.3)
        assert entered.wait(2.0)
    thread.join()
    assert pipeline.on_their_way == 0


def test_cancelled_stack_keeps_its_place_until_it_is_reconstructed():
    pipeline = StackPipeline(1)
    with pytest.raises(PsError), pipeline.place(never) as taken:      # noqa: PT012
        taken('a')
        pipeline.wait('a', 60.0, always, always)
    assert pipeline.on_their_way == 1
    assert code_of(lambda: pipeline.place(always).__enter__()) == ErrorCode.INSPECTION_CANCELLED
    pipeline.reconstructed(info('a'))
    assert pipeline.on_their_way == 0


def test_captures_of_others_take_places_until_they_are_overtaken():
    pipeline = StackPipeline(2)
    for stack_id in ('probe 1', 'probe 2', 'probe 3'):
        pipeline.acquired(stack_id)
    assert code_of(lambda: pipeline.place(always).__enter__()) == ErrorCode.INSPECTION_CANCELLED
    pipeline.reconstructed(info('probe 2'))
    with pipeline.place(never) as taken:
        taken('ours')
    assert pipeline.on_their_way == 2
    pipeline.forget('probe 3')       # its frames were refused
    assert pipeline.on_their_way == 1


def test_stack_that_nobody_will_reconstruct_gives_its_place_back():
    pipeline = StackPipeline(1, patience=0.2)
    pipeline.acquired('a')
    with pipeline.place(never):
        assert pipeline.on_their_way == 1
    pipeline.acquired('b')
    assert code_of(lambda: pipeline.wait('b', 60.0, never, never)) == \
        ErrorCode.INSPECTION_RECONSTRUCTION_LOST
    assert pipeline.on_their_way == 0
