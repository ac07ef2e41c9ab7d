"""What an estimator offers to control engineers: itself as a CasADi function and as C."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from ..control.c_code import write_c
from ..control.casadi import FittedModel
from ..maps import as_map
from ..utils.validation import check_fitted


class Exportable:
    """Of an estimator with a `Predictor`, feature map and kernel map: exports to CasADi and C."""

    def to_casadi(self, name: str = "evgp", *, include_noise: bool = True, parametric: bool = False) -> Any:
        """Write mean and variance as a CasADi function, which differentiates them exactly.

        Parameters
        ----------
        name : str, default="evgp"
            Of the function.
        include_noise : bool, default=True
            Whether the variance is of y, with the learned noise, or of the noise-free g(x).
        parametric : bool, default=False
            Whether all that `partial_fit` changes is a second argument, ``parameters``, which `to_casadi_parameters`
            returns: then an optimal control problem that is built once goes on with a model that learns. Its variance
            takes a few times as long.

        Returns
        -------
        function : casadi.Function
            x of shape (n_features,) -> (mean, variance), each of shape (n_outputs,), in MX; the names of arguments and
            results are ``x``, ``parameters``, ``mean`` and ``variance``. Where it is called with symbols it is put in
            as expressions.

        Raises
        ------
        ImportError
            If CasADi is not installed; the message gives the pip command.
        ValueError, TypeError
            If the kernel, or a map, has no expression in CasADi: the message names it and lists those that have one. A
            map of your own gets one by a method ``to_casadi(x)``, from an MX of shape (n_features, 1) to one of shape
            (n_features_out, 1), or a list of these if it returns a row for each output.
        sklearn.exceptions.NotFittedError
            If the model is not fitted.

        Notes
        -----
        Numbers are those of `predict` but for rounding, which grows where inducing points are hard to tell apart. The
        standard deviation is left to the caller: a square root has no derivative where the variance is 0.

        Examples
        --------
        >>> import numpy as np
        >>> from skevgp import EVGPRegressor
        >>> from skevgp.datasets import make_toy
        >>> X, y = make_toy(random_state=0, return_X_y=True)
        >>> model = EVGPRegressor(n_inducing=10, random_state=0).fit(X, y)
        >>> function = model.to_casadi()
        >>> function
        Function(evgp:(x)->(mean,variance) MXFunction)
        >>> mean, variance = function(0.5)
        >>> bool(np.isclose(float(mean), model.predict([[0.5]])[0]))
        True
        >>> function.factory("linear", ["x"], ["mean", "jac:mean:x"])
        Function(linear:(x)->(mean,jac_mean_x) MXFunction)
        """
        return self._exported().function(name, include_noise, parametric)

    def to_casadi_parameters(self, out: np.ndarray | None = None) -> np.ndarray:
        """Give what the function of ``to_casadi(parametric=True)`` takes beside x, as the model now is.

        Parameters
        ----------
        out : ndarray of shape (n_parameters,), default=None
            Where to put it; None makes a new array.

        Returns
        -------
        parameters : ndarray of shape (n_parameters,)
            For each group of outputs that share inducing points, of which there are m, in the order of their first
            outputs: the weights of the mean, of shape (outputs of the group, m + n_h), then the roots of the
            covariance, (outputs of the group, m + n_h, m + n_h). After all groups what is added to the weights of
            features, (n_outputs, n_h), what is added to the mean, (n_outputs,), and the noise variances, (n_outputs,).
            Rows follow each other. Of these `partial_fit` changes weights and roots.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            If the model is not fitted.
        """
        return self._exported().parameters(out)

    def to_c(
        self,
        path: str | os.PathLike[str],
        name: str = "evgp",
        *,
        jacobian: bool = True,
        include_noise: bool = True,
    ) -> tuple[Path, Path]:
        """Write mean and variance, and their Jacobians, as C that needs nothing but the standard library's mathematics.

        Parameters
        ----------
        path : str or path-like
            A folder, or the file that ends in ``.c``; the header goes beside it.
        name : str, default="evgp"
            What the names of the C functions begin with, and of the files in a folder.
        jacobian : bool, default=True
            Whether there are functions for the Jacobians too.
        include_noise : bool, default=True
            Whether the variance is of y, with the learned noise, or of the noise-free g(x).

        Returns
        -------
        source, header : Path
            The files. ``gcc -std=c99 -O2 -c evgp.c`` builds them, with ``-lm`` where it is linked.

        Raises
        ------
        ImportError, ValueError, TypeError, sklearn.exceptions.NotFittedError
            As `to_casadi`, and if there is no such folder, or the name is taken in C, as ``int`` and ``sin`` are.

        Notes
        -----
        The header declares, with rows of Jacobians following each other (one per output)::

            int evgp_predict(const double *x, double *mean, double *variance);
            int evgp_mean_jacobian(const double *x, double *mean, double *mean_jacobian);
            int evgp_jacobian(const double *x, double *mean, double *variance,
                              double *mean_jacobian, double *variance_jacobian);

        They return 0, take no memory but the stack (the header says how much), keep nothing from call to call, and so
        may run in several threads and in an interrupt. Any result may be NULL. The compiled library also is what
        ``casadi.external("evgp", ...)`` loads.
        """
        function = self.to_casadi(name, include_noise=include_noise)
        columns = getattr(self, "feature_names_in_", None)
        return write_c(function, path, jacobian, columns, include_noise)

    def _exported(self) -> FittedModel:
        check_fitted(self)
        model: Any = self
        features, inputs = (None if each is None else as_map(each) for each in (model.feature_map_, model.kernel_map_))
        return FittedModel(model._predictor, features, inputs, model.n_features_in_)
