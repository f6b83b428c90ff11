"""Finds a cut on one thread, or on several: the steps of `find_cut`, which all parts take before the next begins.

The first part refines the top of the trees, until there are subtrees enough to deal out. From there on each part has
subtrees, and slots, of its own, and nothing is written by two. Between steps the sums of all parts tell, as those of
one do in `find_cut`, where the budget ends. So the cut is the same for any number of parts.
"""

from __future__ import annotations

import numpy as np

from ...support.jit import kernel
from ...support.jit_types import f4, i8, out
from .collect_cut import collect, finish
from .cut import FIRST_STEP, find_cut
from .cut_arrays import (
    BASE,
    BEGIN,
    BUCKET_BITS,
    BUCKETS,
    COUNT,
    DRAWN,
    FULL,
    INFINITE_BITS,
    LOW,
    NEXT,
    OVERFLOW,
    ROOM,
    THRESHOLD,
    WAITING,
    CutNodes,
    Slots,
    Stop,
    Trees,
    from_bits,
    row_of,
    to_bits,
)
from .pixel_scale import ZERO
from .refine import lowered, refine, visit_roots

#: Steps. WHOLE is all that there is for one thread, also where parts cannot find a cut. Of several threads, SOW, PLAN
#: and FINISH are taken by one, REFINE and COLLECT by each part.
WHOLE, SOW, PLAN, REFINE, COLLECT, FINISH = range(6)

#: In place of the limit of a node that was dealt to another part: larger than any but the largest bucket's, so that
#: `collect` takes it for refined.
DEALT = np.int32((1 << 31) - 1)


@kernel(i8, i8, Trees, Stop, f4, out(Slots), out(f4[:, :]), out(CutNodes), nogil=True)
def take_step(step, part, trees, stop, guess, slots, wanted, cut):
    """Takes a step of a part, or of all; `slots.tally` of the first part says which step is NEXT.

    One kernel for all steps, so that programs that find cuts load one.

    Args:
        step: WHOLE, SOW, PLAN, REFINE, COLLECT or FINISH.
        part: number of the part, for REFINE and COLLECT.
        trees, stop, guess, cut: as for `find_cut`; all chunks are resident, unless step is WHOLE.
        slots: `Slots` of all parts.
        wanted: (parts, chunks) float32, filled by COLLECT and FINISH: as of `find_cut`, of each part.

    Returns:
        as `find_cut` after WHOLE and FINISH; after the others, nothing that has a meaning.
    """
    if step == WHOLE:
        return find_cut(trees, stop, guess, slots, wanted, cut)
    row = row_of(slots, part)
    if step == SOW:
        sow(trees, stop, guess, slots)
        # Where nodes were refined in vain, those below them are in no cut.
        if row.tally[DRAWN] <= stop.budget and not row.tally[OVERFLOW]:
            deal(slots)
        plan(stop, guess, slots)
    elif step == PLAN:
        plan(stop, ZERO, slots)
    elif step == REFINE:
        refine(trees, stop, row, from_bits(np.int32(slots.tally[0, THRESHOLD])), row.tally[ROOM])
    elif step == COLLECT:
        collect(trees, stop, row, wanted[part], cut, row.tally[BEGIN], slots.tally[0, LOW])
    else:
        return finish(trees, stop, slots, wanted, cut, slots.tally[0, LOW])
    return 0, FULL, 0, ZERO, -1


@kernel(nogil=True)
def sow(trees, stop, guess, slots):
    """Refines the top of the trees, in the first part, to as many nodes as ROOM says."""
    goal = slots.tally[0, ROOM]
    slots.tally[:] = 0
    slots.sums[:] = 0
    slots.first[:, 0] = 0
    row = row_of(slots, 0)
    tally = row.tally
    largest = from_bits(min(visit_roots(trees, stop, row), INFINITE_BITS))
    threshold = largest * FIRST_STEP
    if guess > ZERO:  # where splats cover surfaces, their number grows with the threshold to the power of -2
        threshold = min(largest, guess * np.float32(np.sqrt(stop.budget / goal)))
    while True:
        threshold = max(threshold, from_bits(stop.smallest))
        refine(trees, stop, row, threshold, stop.budget)
        tally[THRESHOLD] = to_bits(threshold)
        done = tally[WAITING] == 0 or tally[LOW] <= stop.smallest >> BUCKET_BITS
        if tally[OVERFLOW] or done or 2 * tally[DRAWN] > goal:
            return
        threshold = lowered(slots, threshold, goal)


@kernel(nogil=True)
def deal(slots):
    """Deals the nodes that wait to the parts, each to the one that is likely to have least to do."""
    node, limit, instance, pending, tally = slots.node, slots.limit, slots.instance, slots.pending, slots.tally
    work = np.zeros(len(tally))
    left = 0
    for entry in range(tally[0, WAITING]):
        at = pending[0, entry]
        part = 0
        for other in range(1, len(work)):
            part = other if work[other] < work[part] else part
        work[part] += np.float64(min(from_bits(limit[0, at]), np.float32(1e18))) ** 2
        if part == 0:
            pending[0, left] = at
            left += 1
            continue
        to = tally[part, COUNT]
        if to + 1 >= node.shape[1]:
            tally[part, OVERFLOW] = 1
            return
        node[part, to], limit[part, to], instance[part, to] = node[0, at], limit[0, at], instance[0, at]
        pending[part, to] = to
        limit[0, at] = DEALT
        tally[part, COUNT] += 1
    tally[0, WAITING] = left
    for part in range(1, len(tally)):
        count = tally[part, COUNT]
        slots.first[part, 0] = count
        tally[part, WAITING], tally[part, BASE], tally[part, DRAWN] = count, count, count
        tally[0, BASE] -= count
        tally[0, DRAWN] -= count


@kernel(nogil=True)
def plan(stop, guess, slots):
    """Decides, when all parts are refined down to a threshold, what is next: a lower one, or the end.

    Args:
        stop: `Stop`.
        guess: float32, the next threshold, or 0.
        slots: `Slots` of all parts; sets NEXT, THRESHOLD and LOW of the first, ROOM or BEGIN of each.
    """
    tally, sums = slots.tally, slots.sums
    parts = len(tally)
    waiting, drawn, total = np.int64(0), np.int64(0), np.int64(0)
    for part in range(parts):
        if tally[part, OVERFLOW]:
            tally[0, NEXT] = WHOLE
            return
        waiting += tally[part, WAITING]
        drawn += tally[part, DRAWN]
        total += tally[part, BASE]
    threshold = from_bits(np.int32(tally[0, THRESHOLD]))
    reached = np.int64(0) if waiting == 0 else tally[0, THRESHOLD] >> BUCKET_BITS
    low = np.int64(-1)
    for bucket in range(BUCKETS - 1, reached - 1, -1):
        for part in range(parts):
            total += sums[part, bucket]
        if total > stop.budget:
            low = bucket
            break
    if low < 0 and waiting and reached > stop.smallest >> BUCKET_BITS:
        threshold = min(threshold, guess) if guess > ZERO else lowered(slots, threshold, stop.budget)
        tally[0, NEXT], tally[0, THRESHOLD] = REFINE, to_bits(max(threshold, from_bits(stop.smallest)))
        for part in range(parts):
            tally[part, ROOM] = stop.budget - (drawn - tally[part, DRAWN])
        return
    # The largest bucket is not told from nodes that were dealt.
    tally[0, NEXT], tally[0, LOW] = COLLECT if low < BUCKETS - 1 else WHOLE, low
    begin = np.int64(0)
    for part in range(parts):
        tally[part, BEGIN] = begin
        begin += tally[part, BASE] + 1  # `collect` writes one more before it knows whether that is drawn
        for bucket in range(low + 1, BUCKETS):
            begin += sums[part, bucket]
