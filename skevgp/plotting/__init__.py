"""Pictures in scikit-learn's Display convention: ``from_estimator`` computes, ``plot`` draws. Needs matplotlib."""

from .coefficients import CoefficientDisplay
from .learning_curve import LearningCurveDisplay
from .posterior import PosteriorDisplay

__all__ = ["CoefficientDisplay", "LearningCurveDisplay", "PosteriorDisplay"]
