"""Who has a stack, and who is too new to have it, without ROS."""
from ps_inspection.reconstruction_watch import GRACE_S, SETTLE_S, ReconstructionWatch


class Graph:
    """Publishers that come and go, and a clock."""

    def __init__(self) -> None:
        self.now, self.there = 100.0, ['old']
        self.watch = ReconstructionWatch(lambda: self.there, lambda: self.now)
        self.watch.look()

    def after(self, seconds: float, *there: str) -> None:
        self.now, self.there = self.now + seconds, list(there)


def test_new_one_is_ready_once_all_know_it():
    graph = Graph()
    assert not graph.watch.ready()
    graph.after(SETTLE_S, 'old')
    assert graph.watch.ready()
    # killed and started again: known for long is only the dead one
    graph.after(3.0, 'old', 'new')
    assert not graph.watch.ready()
    graph.after(SETTLE_S, 'old', 'new')
    assert graph.watch.ready()
    graph.after(20.0)
    assert not graph.watch.ready()


def test_one_that_came_back_is_new():
    graph = Graph()
    graph.after(10.0)
    graph.watch.look()
    graph.after(10.0, 'old')
    assert not graph.watch.ready()


def test_result_is_expected_as_long_as_the_one_with_the_stack_is_there():
    graph = Graph()
    alive = graph.watch.follow()
    graph.after(50.0, 'old')
    assert alive()
    graph.after(1.0)
    assert not alive()


def test_one_that_is_new_since_the_stack_gets_a_grace_only():
    graph = Graph()
    alive = graph.watch.follow()
    graph.after(10.0, 'old', 'new')
    assert alive()
    graph.after(GRACE_S - 0.1, 'new')
    assert alive()
    graph.after(0.2, 'new')
    assert not alive()
    assert graph.watch.follow()()       # the next stack is one that it got
