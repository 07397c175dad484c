"""Errors of rollouts against ground truth and their confidence intervals (``rollouts``), and metrics of bodies that bend (``bodies``)."""

from gpe_pl.metrics.energy_distance import energy_distance as energy_distance
from gpe_pl.metrics.rollouts import BOTH as BOTH
from gpe_pl.metrics.rollouts import HORIZONS as HORIZONS
from gpe_pl.metrics.rollouts import UNITS as UNITS
from gpe_pl.metrics.rollouts import Horizon as Horizon
from gpe_pl.metrics.rollouts import Interval as Interval
from gpe_pl.metrics.rollouts import OneStepNMSE as OneStepNMSE
from gpe_pl.metrics.rollouts import Record as Record
from gpe_pl.metrics.rollouts import RolloutMSE as RolloutMSE
from gpe_pl.metrics.rollouts import bootstrap_interval as bootstrap_interval
from gpe_pl.metrics.rollouts import bootstrap_ratio as bootstrap_ratio
from gpe_pl.metrics.rollouts import compared as compared
from gpe_pl.metrics.rollouts import displacement as displacement
from gpe_pl.metrics.rollouts import median_of_means as median_of_means
from gpe_pl.metrics.rollouts import per_frame_mse as per_frame_mse
from gpe_pl.metrics.rollouts import rollout_metrics as rollout_metrics
