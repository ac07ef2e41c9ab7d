"""Displays in scikit-learn's convention: ``from_...`` computes, ``plot`` draws. They need matplotlib."""

from .calibration import CalibrationDisplay
from .coefficients import CoefficientDisplay
from .feature_report import FeatureReportDisplay
from .learning_curve import LearningCurveDisplay
from .loss import LossDisplay
from .posterior import PosteriorDisplay
from .rollout import RolloutDisplay
from .signals import SignalsDisplay

__all__ = [
    "CalibrationDisplay",
    "CoefficientDisplay",
    "FeatureReportDisplay",
    "LearningCurveDisplay",
    "LossDisplay",
    "PosteriorDisplay",
    "RolloutDisplay",
    "SignalsDisplay",
]
