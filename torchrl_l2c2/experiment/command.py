"""The command: settings from a shell, by Hydra, to a run and its result.

``python train.py`` in a clone, ``python -m torchrl_l2c2.experiment`` anywhere.
"""

from __future__ import annotations

import dataclasses
import logging
import sys
import warnings
from contextlib import closing
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from torchrl_l2c2.experiment.config import GROUPS, ExperimentConfig, OtherRunError
from torchrl_l2c2.experiment.manual import manual
from torchrl_l2c2.experiment.settings import SettingError, describe

PACKAGE = Path(__file__).parents[1]
# Beside the package in a clone, within it when installed.
CONF = next(folder for folder in (PACKAGE / "conf", PACKAGE.parent / "conf") if folder.is_dir())


def register() -> None:
    """Gives Hydra every choice of every group, from the settings' own defaults.

    ``conf/`` holds what combines them.
    """
    store = ConfigStore.instance()
    for group, choices in GROUPS.items():
        for name, chosen in choices.items():
            store.store(group=group, name=name, node=_node(chosen))
    unknown = dict.fromkeys(("env_id", "noise_scale", "max_steps", "solved_at"))
    any_task = {"name": "${task.env_id}", **unknown}
    store.store(
        group="task", name="gymnasium", node={**_node(GROUPS["task"]["swingup"]), **any_task}
    )
    config = dataclasses.asdict(ExperimentConfig())
    store.store(name="settings", node={name: config[name] for name in describe(ExperimentConfig)})
    store.store(group="hydra/help", name="settings", node={"template": manual()})


def _node(chosen: Any) -> dict[str, Any]:
    values = {k: list(v) if isinstance(v, tuple) else v for k, v in vars(chosen).items()}
    if not hasattr(chosen, "usual_replay"):
        return values
    usual = [
        {"override /replay@_global_.replay": chosen.usual_replay},
        {"override /optimizer@_global_.optimizer": chosen.usual_optimizer},
    ]
    return {"defaults": [*usual, "_self_"], **values}


def main() -> None:
    """Runs what the command line says."""
    register()
    _main()


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def _main(values: DictConfig) -> None:
    hints = {
        SettingError: "--help lists every setting.",
        OtherRunError: "outputs=FOLDER chooses another folder.",
    }
    try:
        plain: Any = OmegaConf.to_container(values, resolve=True)
        run(ExperimentConfig.from_dict(plain), values.resume)
    except (ValueError, OSError, RuntimeError, FloatingPointError) as error:
        print(f"error: {error} {hints.get(type(error), '')}".rstrip(), file=sys.stderr)
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise  # Hydra counts it, goes on with the other jobs, and shows it again at the end.
        sys.exit(1)


def run(config: ExperimentConfig, resume: str | None) -> None:
    """One run in the folder that Hydra chose, its progress and its result."""
    # Here, as settings are checked before anything waits for torch.
    from torchrl_l2c2.experiment.reports import compare_with_paper, finished_run
    from torchrl_l2c2.experiment.signals import Interrupted
    from torchrl_l2c2.experiment.training import Experiment

    for chatty in ("torchrl", "matplotlib", "torch"):
        logging.getLogger(chatty).setLevel(logging.ERROR)
    warnings.simplefilter("ignore", FutureWarning)
    folder = Path(HydraConfig.get().runtime.output_dir)
    chosen = (config.task, config.algorithm, config.regularizer)
    print(f"{', '.join(group.name for group in chosen)}, seed {config.seed}: {folder}")
    try:
        finished = finished_run(folder, config.to_dict())
        if finished is None:
            with closing(Experiment(config, folder, resume=resume)) as experiment:
                experiment.train(progress=True)
                tests = [experiment.test(sampled=s, progress=True) for s in (False, True)]
                finished = experiment.finish(*tests)
    except Interrupted as interruption:
        print(interruption, file=sys.stderr)
        sys.exit(interruption.exit_status)
    except KeyboardInterrupt:  # While testing, which begins anew, or a second one while training.
        print(f"interrupted; the same command continues from {folder}.", file=sys.stderr)
        sys.exit(130)
    print(compare_with_paper(finished))
    print(f"picture: {folder / 'learning_curves.png'}")
