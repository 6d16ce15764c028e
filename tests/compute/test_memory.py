"""Memory that is used again, and never while somebody still looks at it."""

import sys
import threading

import torch

from nsvq_lightning.compute.memory import Workspace, recycled

# A shape of its own size, so that no buffer of another test fits.
SHAPE = (123_457, 5)


def test_memory_comes_back_when_its_tensor_is_gone() -> None:
    first = recycled(SHAPE)
    place = first.data_ptr()
    del first
    again = recycled(SHAPE)
    assert again.data_ptr() == place
    part = again[3]
    del again
    assert recycled(SHAPE).data_ptr() != place
    assert part.shape == (5,)


def test_two_tensors_never_share_memory() -> None:
    tensors = [recycled(SHAPE) for _ in range(3)]
    for i, tensor in enumerate(tensors):
        tensor.fill_(i)
    assert [float(tensor.mean()) for tensor in tensors] == [0.0, 1.0, 2.0]
    assert len({tensor.data_ptr() for tensor in tensors}) == 3


def test_a_smaller_tensor_may_take_a_larger_buffer() -> None:
    large = recycled(SHAPE)
    place = large.data_ptr()
    del large
    assert recycled((SHAPE[0] - 1000, 5)).data_ptr() == place


def test_autograd_takes_the_memory_over() -> None:
    class Ones(torch.autograd.Function):
        place = 0

        @staticmethod
        def forward(ctx: object, x: torch.Tensor) -> torch.Tensor:
            return x.sum()

        @staticmethod
        def backward(ctx: object, *grads: torch.Tensor) -> torch.Tensor:
            gradient = recycled(SHAPE)
            Ones.place = gradient.data_ptr()
            return gradient.fill_(1)

    x = torch.zeros(SHAPE, requires_grad=True)
    Ones.apply(x).backward()  # type: ignore[no-untyped-call]
    assert x.grad is not None
    assert x.grad.data_ptr() == Ones.place


def test_a_workspace_is_lent_to_one_at_a_time() -> None:
    first, second = Workspace.borrow(), Workspace.borrow()
    assert first is not second
    array = first.array("a", 10)
    assert array.ctypes.data % 64 == 0
    array[:] = 7
    assert first.array("a", 5).base is array.base
    first.give_back()
    assert Workspace.borrow() is first
    second.give_back()
    first.give_back()


def test_threads_do_not_get_the_same_memory() -> None:
    wrong: list[int] = []

    def use(number: int) -> None:
        for _ in range(300):
            tensor = recycled((1000 + number, 7))
            tensor.fill_(number)
            if float(tensor.sum()) != number * tensor.numel():
                wrong.append(number)

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=use, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    assert not wrong
