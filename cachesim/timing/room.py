"""The same state with more room: tables, delays and pools grow where they ran out."""

from __future__ import annotations

import numpy as np

from cachesim.timing import records
from cachesim.timing.partition import is_filling_table, larger_draws
from cachesim.timing.state import Route, State
from cachesim.timing.tags import Tags


def _with_room(route: Route) -> Route:
    if not is_filling_table(route.draws):
        return route
    return route._replace(draws=larger_draws(route.draws))


def _with_longer_delays(tags: Tags) -> Tags:
    instances, room = tags.delay.shape
    longer = np.zeros((instances, 2 * room), records.WAITING)
    for node in range(instances):
        head, count = (int(tags.nodes[node][f"delay_{name}"]) for name in ("head", "count"))
        longer[node, :count] = tags.delay[node, (head + np.arange(count)) % room]
    tags.nodes["delay_head"] = 0
    return tags._replace(delay=longer)


def with_more_room(state: State) -> State:
    """The same state with larger tables of drawn slices where they fill up, longer delays before
    the L2 where one is full, and twice as many requests in its pool where that runs out.
    """
    state = state._replace(
        l2_route=_with_room(state.l2_route), llc_route=_with_room(state.llc_route)
    )
    if state.pool.machine[0]["lacks_room"]:
        state = state._replace(l2=_with_longer_delays(state.l2))
        state.pool.machine[0]["lacks_room"] = 0
    pool = state.pool
    if pool.machine[0]["free_top"] >= pool.machine[0]["num_pool"]:
        return state
    old = len(pool.requests)
    requests = records.zeros(2 * old, records.REQUEST)
    requests[:old] = pool.requests
    free = np.zeros(2 * old, np.int32)
    top = int(pool.machine[0]["free_top"])
    free[:old] = np.arange(old, 2 * old)
    free[old : old + top] = pool.free[:top]
    pool.machine[0]["free_top"] = old + top
    return state._replace(pool=pool._replace(requests=requests, free=free))
