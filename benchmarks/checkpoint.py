"""Time of a checkpoint: ``python -m benchmarks.checkpoint``.

Fills the replay buffer on Swingup, as a real run does, and times whole checkpoints: gathering the
state, writing, flushing to the disk and checking the file.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time

from torchrl_l2c2.experiment import Experiment, ExperimentConfig, PPORPEConfig, TaskConfig

REPETITIONS = 15


def main() -> None:
    """Prints the median time of a checkpoint and its share of the default interval."""
    argparse.ArgumentParser(
        prog="python -m benchmarks.checkpoint", description=__doc__
    ).parse_args()
    config = ExperimentConfig(
        task=TaskConfig(episodes=10), algorithm=PPORPEConfig(updates=1), compile=False
    )
    with tempfile.TemporaryDirectory() as folder:
        experiment = Experiment(config, folder)
        experiment.train(progress=True)
        times = []
        for _ in range(REPETITIONS):
            start = time.perf_counter()
            path = experiment.save()
            times.append(time.perf_counter() - start)
        assert path is not None
        median, size = statistics.median(times), path.stat().st_size
    share = median / config.checkpoint_interval
    print(
        f"a checkpoint of {size / 1e6:.1f} MB takes {1e3 * median:.0f} ms (median of "
        f"{REPETITIONS}), {100 * share:.3f} % of the {config.checkpoint_interval:.0f} s between two"
    )


if __name__ == "__main__":
    main()
