"""A CasADi function as self-contained C, with functions around it that need no knowledge of CasADi."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..utils.casadi import casadi
from ..utils.files import replacing

# Comments of CasADi on each instruction, including whole matrices.
_EXPLANATION = re.compile(r"^ *\/\* #\d+:.*?\*\/\n", re.MULTILINE | re.DOTALL)

# Names with a meaning in the generated C: words of the language and variables, ...
_WORDS = """
auto break case char const continue default do double else enum extern float for goto if inline int long register
restrict return short signed sizeof static struct switch typedef union unsigned void volatile while asm typeof alignas
alignof bool constexpr false nullptr static_assert thread_local true typeof_unqual linux unix main
x mean variance arg res iw w abort abs calloc exit free labs malloc memcpy memset printf puts strcpy strlen
fpclassify isfinite isnormal signbit isgreater isgreaterequal isless islessequal islessgreater isunordered signgam
HUGE_VAL HUGE_VALF HUGE_VALL INFINITY NAN math_errhandling
"""
# ... functions of <math.h> for three types each, ...
_FUNCTIONS = """
acos asin atan atan2 cos sin tan acosh asinh atanh cosh sinh tanh exp exp2 exp10 expm1 frexp ilogb ldexp log log10 log1p
log2 logb modf scalb scalbn scalbln cbrt fabs hypot pow sqrt erf erfc lgamma tgamma gamma ceil floor nearbyint rint
lrint llrint round lround llround trunc fmod remainder drem remquo copysign nan nextafter nexttoward fdim fmax fmin fma
isinf isnan finite significand j0 j1 jn y0 y1 yn sincos
"""
_TAKEN = {*_WORDS.split(), *(f"{name}{kind}" for name in _FUNCTIONS.split() for kind in ("", "f", "l"))}
# ... and names that begin with one of these.
_TAKEN_STARTS = ("casadi_", "FP_", "MATH_")

_HEADER = """\
/* {name}: mean and variance of {n_outputs} outputs, given {n_features} inputs.

   x: {n_features} inputs, in the order and units of the columns of X that the model was fitted to{columns}.
   mean, variance: {n_outputs} outputs each, in the units of y and their squares; the variance is {of}.
   mean_jacobian, variance_jacobian: derivatives in x, {n_outputs} rows of {n_features}, row after row.

   All functions return 0. Results may be NULL. They use the stack alone, at most {stack} bytes of it, and keep nothing
   between calls: threads may share them.

   Build: cc -std=c99 -O2 -c {source}, and link with -lm.
   Written by skevgp {version} with CasADi {casadi}. */
#ifndef {guard}_H
#define {guard}_H

#define {guard}_N_FEATURES {n_features}
#define {guard}_N_OUTPUTS {n_outputs}

#ifdef __cplusplus
extern "C" {{
#endif

{declarations}

#ifdef __cplusplus
}}
#endif

#endif
"""
_SOURCE = """\
/* {name}: see {header}. Written by skevgp {version} with CasADi {casadi}. */
#include "{header}"

#ifdef __GNUC__
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif
{generated}
#ifdef __GNUC__
#pragma GCC diagnostic pop
#endif

{definitions}
"""
_DEFINITION = """\
{declaration} {{
  const double *arg[{n_arg}] = {{x}};
  double *res[{n_res}] = {{{results}}};
  casadi_int iw[{n_iw}];
  double w[{n_w}];
  return {function}(arg, res, iw, w, 0);
}}
"""


def write_c(
    function: Any,
    path: str | os.PathLike[str],
    jacobian: bool,
    columns: Iterable[str] | None = None,
    include_noise: bool = True,
) -> tuple[Path, Path]:
    """Write a `casadi.Function` x -> (mean, variance) as C; return the paths of source and header."""
    ca, name = casadi(), function.name()  # names in C begin with the function's name
    if name in _TAKEN or name.startswith(_TAKEN_STARTS):
        raise ValueError(f"name={name!r} is a reserved word of C. Choose another name.")
    source = Path(path)
    source = source if source.suffix == ".c" else source / f"{name}.c"
    if not source.parent.is_dir():
        raise ValueError(f"path={os.fspath(path)!r}: the folder {str(source.parent)!r} does not exist.")
    header = source.with_suffix(".h")
    parts = _parts_of(function, jacobian)
    generator = ca.CodeGenerator(name, {"with_header": False, "with_export": False, "prefix": f"{name}_"})
    for part, _ in parts.values():
        generator.add(part)
    declared = {
        own: f"int {own}(const double *x, {', '.join(f'double *{result}' for result in results)})"
        for own, (_, results) in parts.items()
    }
    told = {
        "name": name,
        "version": _version(),
        "casadi": ca.CasadiMeta.version(),
        "header": header.name,
        "source": source.name,
    }
    definitions = [_definition(declared[own], part, results) for own, (part, results) in parts.items()]
    generated = _EXPLANATION.sub("", generator.dump())
    names = "" if columns is None else f":\n   {', '.join(columns)}"
    declarations = _HEADER.format(
        guard=_as_macro(header.stem),
        n_features=function.numel_in(0),
        n_outputs=function.numel_out(0),
        columns=names.replace("/*", "/ *").replace("*/", "* /"),
        of="that of y, with its noise" if include_noise else "without the noise of y",
        stack=max(map(_stack, (part for part, _ in parts.values()))),
        declarations="\n".join(f"{text};" for text in declared.values()),
        **told,
    )
    with replacing(source) as code, replacing(header) as declaring:
        code.write(_SOURCE.format(generated=generated, definitions="\n".join(definitions), **told).encode())
        declaring.write(declarations.encode())
    return source, header


def _as_macro(stem: str) -> str:
    """Turn the stem of a file name into the name of a macro."""
    macro = re.sub(r"\W", "_", stem, flags=re.ASCII).upper()
    return f"MODEL_{macro}" if macro[0].isdigit() else macro


def _parts_of(function: Any, jacobian: bool) -> dict[str, tuple[Any, list[str]]]:
    """Return the C functions to write: name -> (casadi.Function, names of its results)."""
    ca, name = casadi(), function.name()
    x = ca.MX.sym("x", function.size_in(0))
    mean, variance = function(x)
    found = {"predict": (name, {"mean": mean, "variance": variance})}
    if jacobian:
        # CasADi stores columns, so that the transpose has the rows of C.
        slopes = {
            "mean_jacobian": ca.densify(ca.jacobian(mean, x)).T,
            "variance_jacobian": ca.densify(ca.jacobian(variance, x)).T,
        }
        found["mean_jacobian"] = f"{name}_mean_jac", {"mean": mean, "mean_jacobian": slopes["mean_jacobian"]}
        found["jacobian"] = f"{name}_jac", {"mean": mean, "variance": variance, **slopes}
    return {
        f"{name}_{called}": (ca.Function(inside, [x], list(own.values()), ["x"], list(own)), list(own))
        for called, (inside, own) in found.items()
    }


def _definition(declaration: str, part: Any, results: list[str]) -> str:
    return _DEFINITION.format(
        declaration=declaration,
        n_arg=part.sz_arg(),
        n_res=part.sz_res(),
        results=", ".join(results),
        n_iw=max(1, part.sz_iw()),
        n_w=max(1, part.sz_w()),
        function=part.name(),
    )


def _version() -> str:
    """Return the version of the package, whose __init__ imports this module."""
    return importlib.import_module(__name__.partition(".")[0]).__version__


def _stack(part: Any) -> int:
    """Bound the bytes of stack that a function needs, with 1 kB for the calls themselves."""
    numbers = int(np.sum([part.sz_arg(), part.sz_res(), part.sz_iw(), part.sz_w()]))
    return 8 * numbers + 1024
