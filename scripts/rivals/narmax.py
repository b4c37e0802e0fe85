"""SysIdentPy's NARMAX (forward regression, BIC) on what the recalibrated blocks leave.

A polynomial of the second degree in the inputs and their lags, without feedback of the output
(NFIR): it is simulated, not predicted a step ahead. It is named as Operon's expressions are.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from block_rows import Array
from operon import diagnose_by

LAG = 3
"""Rows back; a row is a mean over 8 ms."""
MOST_TERMS = 15


def diagnose_task(task: Any) -> dict[str, Any]:
    """Return a verdict on a task of the benchmark."""
    return diagnose_by(task, regress)


def regress(inputs: Array, target: Array, held: Array) -> Any:
    """Return the model's values on the training and on the held-out rows; NaN in the first rows."""
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    model = (
        FROLS(
            order_selection=True,
            n_info_values=MOST_TERMS,
            info_criteria="bic",
            estimator=LeastSquares(),
            xlag=[[*range(1, LAG + 1)] for _ in range(inputs.shape[1])],
            ylag=1,
            basis_function=Polynomial(degree=2),
            model_type="NFIR",
        )
        if inputs.shape[1] > 1
        else FROLS(basis_function=Polynomial(degree=2), model_type="NFIR")
    )
    # A row's own inputs count too: the model knows lags from 1 on.
    ahead, held_ahead = (np.vstack([x[1:], x[-1:]]) for x in (inputs, held))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.fit(X=ahead, y=target[:, None])
        found = np.ravel(model.predict(X=ahead, y=target[:, None]))
        on_held = np.ravel(model.predict(X=held_ahead, y=np.zeros((len(held), 1))))
    return found, on_held
