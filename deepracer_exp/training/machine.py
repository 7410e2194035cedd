"""Use of the machine while a training runs, for MLflow's page of system metrics."""

import psutil
import torch


def machine_use(device: str) -> dict[str, float]:
    """Return the use of cores and memory of this machine, in the columns of a tracker.

    `cpu_percent` is a mean since the last call and of all cores; `memory_mb` and `gpu_memory_mb` are millions of bytes.
    The GPU's is that of `device`, if it is one.
    """
    memory = psutil.virtual_memory()
    use = {
        "cpu_percent": psutil.cpu_percent(),
        "memory_mb": memory.used / 1e6,
        "memory_percent": memory.percent,
    }
    if device != "cpu":
        free, total = torch.cuda.mem_get_info(torch.device(device))
        use["gpu_memory_mb"] = (total - free) / 1e6
    return use
