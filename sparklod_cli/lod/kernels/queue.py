"""The traversal's priority queue: a binary heap of slots, in an array."""

from __future__ import annotations

from ...support.jit import kernel


@kernel(inline=True)
def comes_before(node, limit, instance, a, b):
    """Whether slot `a` is refined before slot `b`: by pixel scale, then instance, then index, the greatest first."""
    if limit[a] != limit[b]:
        return limit[a] > limit[b]
    if instance[a] != instance[b]:
        return instance[a] > instance[b]
    return node[a] > node[b]


@kernel(nogil=True)
def sift_up(node, limit, instance, heap, at):
    """Moves the heap's entry at `at` up to where the heap is in order."""
    while at > 0:
        above = (at - 1) >> 1
        if not comes_before(node, limit, instance, heap[at], heap[above]):
            return
        heap[at], heap[above] = heap[above], heap[at]
        at = above


@kernel(nogil=True)
def sift_down(node, limit, instance, heap, length):
    """Moves the heap's first entry down to where the heap is in order."""
    at = 0
    while True:
        child = 2 * at + 1
        if child >= length:
            return
        if child + 1 < length and comes_before(node, limit, instance, heap[child + 1], heap[child]):
            child += 1
        if not comes_before(node, limit, instance, heap[child], heap[at]):
            return
        heap[at], heap[child] = heap[child], heap[at]
        at = child
