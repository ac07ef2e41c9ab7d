"""Pictures in scikit-learn's Display convention: ``from_...`` computes, ``plot`` draws. Needs matplotlib."""

from .coefficients import CoefficientDisplay
from .learning_curve import LearningCurveDisplay
from .posterior import PosteriorDisplay
from .rollout import RolloutDisplay
from .signals import SignalsDisplay

__all__ = ["CoefficientDisplay", "LearningCurveDisplay", "PosteriorDisplay", "RolloutDisplay", "SignalsDisplay"]
