"""Every task: what a process of its own measures, so that none can spoil another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from experiments.silicon import tasks_latency, tasks_rates, tasks_texels, tasks_workload
from experiments.silicon.cases import PICTURES
from experiments.silicon.session import Session

Measure = Callable[[Session, str], None]


@dataclass(frozen=True)
class Task:
    """name: as `--only` takes it. words: what its function is told. timeout_s: then it is ended.
    profiled: "" or the first word of the kernels that ncu is to look at.
    """

    name: str
    measure: Measure
    words: str = ""
    timeout_s: float = 60.0
    profiled: str = ""


def list_tasks() -> list[Task]:
    """All tasks, in the order in which they are run: the most wanted first."""
    pictures = [f"{scene}_{width}x{height}" for scene, width, height in PICTURES]
    tasks = [Task("properties", tasks_latency.measure_properties)]
    for name in pictures:
        tasks.append(Task(f"times-{name}", tasks_workload.measure_times, name, 90))
        tasks.append(
            Task(f"counters-{name}", tasks_workload.profile_launches, name, 150, profiled="afis")
        )
    tasks += [
        Task("counters-texels", tasks_texels.profile_texels, timeout_s=150, profiled="texels"),
        Task("chase-load", tasks_latency.measure_chase, "load"),
        Task("chase-texture-linear", tasks_latency.measure_chase_linear),
        Task("chase-texture-array", tasks_latency.measure_chase_array),
        Task("chase-past-l1", tasks_latency.measure_chase, "past_l1"),
        Task("near-far", tasks_latency.measure_near_far),
        Task("neighbours", tasks_texels.measure_neighbours),
        Task("bandwidth-l1", tasks_rates.measure_own_bandwidth, "l1"),
        Task("bandwidth-l2", tasks_rates.measure_own_bandwidth, "l2"),
        Task("bandwidth-read", tasks_rates.measure_shared_bandwidth, "read"),
        Task("bandwidth-write", tasks_rates.measure_shared_bandwidth, "write"),
        Task("texture-rate", tasks_rates.measure_texture_rate),
        Task("scan-l1", tasks_latency.measure_scan, "l1"),
        Task("scan-l2", tasks_latency.measure_scan, "l2"),
        Task("launch", tasks_rates.measure_launch),
        Task("chase-readonly", tasks_latency.measure_chase, "readonly"),
        Task("chase-load-32", tasks_latency.measure_chase, "load-32"),
        Task(f"filtering-{pictures[0]}", tasks_workload.measure_filtering, pictures[0]),
    ]
    return tasks
