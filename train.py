"""Trains one run of the paper's experiment: `python train.py task=swingup regularizer=l2c2`.

`python train.py --help` lists every setting; `-m` runs several values of some one after another.
"""

import logging
import sys
import warnings
from contextlib import closing
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from torchrl_l2c2.experiment import Experiment, ExperimentConfig
from torchrl_l2c2.experiment.reports import compare_with_paper
from torchrl_l2c2.experiment.training import Interrupted, finished_run


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(settings: DictConfig) -> None:
    for chatty in ("torchrl", "matplotlib", "torch"):
        logging.getLogger(chatty).setLevel(logging.ERROR)
    warnings.simplefilter("ignore", FutureWarning)
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        config = ExperimentConfig.from_dict(OmegaConf.to_container(settings, resolve=True))
        print(f"{describe(config)}: {folder}")
        run = finished_run(folder, config)
        if run is None:
            with closing(Experiment(config, folder, resume=settings.resume)) as experiment:
                experiment.train(progress=True)
                run = experiment.finish(experiment.test(progress=True))
    except Interrupted as interruption:
        print(interruption, file=sys.stderr)
        sys.exit(interruption.exit_status)
    except KeyboardInterrupt:  # While testing, which begins anew, or a second one while training.
        print(f"interrupted; the same command continues from {folder}.", file=sys.stderr)
        sys.exit(130)
    except (ValueError, OSError, RuntimeError, FloatingPointError) as error:
        print(f"error: {error}", file=sys.stderr)
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise  # Hydra counts it, goes on with the other jobs, and shows it again at the end.
        sys.exit(1)
    print(compare_with_paper(run))
    print(f"picture: {folder / 'learning_curves.png'}")


def describe(config: ExperimentConfig) -> str:
    return ", ".join(
        (config.task.name, config.algorithm.name, config.regularizer.name, f"seed {config.seed}")
    )


if __name__ == "__main__":
    main()
