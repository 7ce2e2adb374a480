# SPDX-License-Identifier: Apache-2.0
"""The Jacobian checker of the test suite: central differences with an error bound, and automatic
derivatives.

The step of a difference has the smallest bound of truncation (the change between neighboring
steps) plus rounding. The bound is part of the tolerance, and a bound too large to be useful fails
the test. The automatic derivative comes from jax: from a function written for it, or from
loopcal's source with jax.numpy in place of numpy (`under_jax`), which is independent of loopcal's
derivatives.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

# Steps as fractions of the scale. Fourth-order differences are best near eps^(1/5) = 7e-4; the
# ladder surrounds it.
_LADDER = 10.0 ** np.arange(-1.0, -5.1, -0.5)
# Rounding of the 4-point formula: (8 + 8 + 1 + 1) / 12 ulps of the function over the step, times 4
# for its own error.
_ROUNDING = 6.0 * np.finfo(float).eps
# The truncation of a step is judged by its change to the next; ten covers outputs that agree there
# by chance.
_SAFETY = 10.0
# A bound above this fraction of the largest scaled column proves nothing.
_USEFUL = 1e-6
# Automatic derivatives carry rounding only, over a few hundred operations.
_AUTOMATIC = 1e-11
# Fusion of loops takes most of the time that XLA needs to compile (0.8 s of 0.9 s for the
# derivative of a logarithm of rotations), and a derivative is evaluated at a few points only.
_QUICK_COMPILATION = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": 1,
}


def central_difference(
    function: Callable[[Array], ArrayLike], x: Array, scale: Array, is_batched: bool = False
) -> tuple[Array, Array]:
    """Derivative of a function by fourth-order central differences, with an error bound.

    `f' = (8 (f(h) - f(-h)) - (f(2h) - f(-2h))) / 12h`, the step of each unknown chosen from a
    ladder.

    Parameters
    ----------
    function : callable
        From (k,) to an array (...) of any shape; from (m, k) to (m, ...) where it `is_batched`.
    x : (k,)
    scale : (k,)
        Change of each unknown over which the function bends noticeably (1 rad, the size of the
        robot).

    Returns
    -------
    derivative : (..., k)
    bound : (k,)
        Largest error to be expected in each column.
    """
    columns, bounds = [], []
    for k, unit in enumerate(np.eye(x.size)):
        steps = scale[k] * _LADDER
        points = x + np.multiply.outer(np.multiply.outer(steps, [2.0, 1.0, -1.0, -2.0]), unit)
        flat = points.reshape(-1, x.size)
        values = np.asarray(function(flat) if is_batched else [function(each) for each in flat])
        far, near, back, behind = np.moveaxis(
            values.reshape(*points.shape[:2], *values.shape[1:]), 1, 0
        )
        tall = (-1,) + (1,) * (far.ndim - 1)
        tries = (8.0 * (near - back) - (far - behind)) / (12.0 * steps).reshape(tall)
        size = float(np.max(np.abs(near)))
        errors = [
            float(np.max(np.abs(tries[i] - tries[i + 1])))
            + _ROUNDING * size / (scale[k] * _LADDER[i + 1])
            for i in range(len(steps) - 1)
        ]
        best = int(np.argmin(errors))
        columns.append(tries[best])
        bounds.append(_SAFETY * errors[best])
    return np.stack(columns, axis=-1), np.array(bounds)


def check_jacobian(
    function: Callable[[Array], ArrayLike],
    jacobian: ArrayLike,
    x: ArrayLike,
    *,
    scale: ArrayLike,
    atol: float = 0.0,
    atol_reason: str = "none beyond the error of the reference itself",
    automatic: Callable[..., object] | None = None,
    package: str = "loopcal",
    is_batched: bool = False,
) -> None:
    """Fail unless an analytic Jacobian agrees with central differences and, where given, with jax.

    Parameters
    ----------
    function : callable
        From (k,) to an array of any shape; perturb a whole batch at once by one common x.
    jacobian : array (..., k)
        The analytic derivative at `x`.
    x : (k,)
    scale : (k,) or number
        Change of each unknown over which the function bends noticeably.
    atol : float
        Error allowed on top of the error of the reference, in the unit of function * scale / x.
    atol_reason : str
        Why `atol` is what it is; printed on failure.
    automatic : callable, optional
        The function for jax: another one, or `function` itself where it only calls loopcal and
        takes jax arrays.
    package : str
        Modules whose numpy is replaced while jax traces `automatic`.
    is_batched : bool
        Whether `function` takes many points (m, k) at once.
    """
    point = np.asarray(x, dtype=float)
    scales = np.broadcast_to(np.asarray(scale, dtype=float), point.shape)
    analytic = np.asarray(jacobian) * scales
    largest = max(float(np.max(np.abs(analytic))), float(np.finfo(float).tiny))
    difference, bound = central_difference(function, point, scales, is_batched)
    if analytic.shape != difference.shape:
        raise AssertionError(
            f"Jacobian of shape {analytic.shape}, differences of shape {difference.shape}"
        )
    scaled_bound = bound * scales
    if np.max(scaled_bound) > max(_USEFUL * largest, atol):
        raise AssertionError(
            f"differences too coarse to prove anything: bound {scaled_bound}, entries to "
            f"{largest:.3g}"
        )
    _compare("central differences", analytic, difference * scales, scaled_bound + atol, atol_reason)
    if automatic is not None:
        reference = automatic_derivative(automatic, point, package) * scales
        _compare(
            "jax",
            analytic,
            reference,
            np.full(point.size, _AUTOMATIC * largest + atol),
            atol_reason,
        )


def _compare(name: str, analytic: Array, reference: Array, tolerance: Array, reason: str) -> None:
    error = np.abs(analytic - reference)
    wrong = ~(error <= tolerance)  # a NaN is wrong
    if np.any(wrong):
        place = tuple(int(i) for i in np.argwhere(wrong)[0])
        raise AssertionError(
            f"{int(np.sum(wrong))} entries differ from {name}, the first at {place}: "
            f"{analytic[place]:.12g} against"
            f" {reference[place]:.12g}, error {error[place]:.2e}, allowed "
            f"{tolerance[place[-1]]:.2e} (atol: {reason})"
        )


def automatic_derivative(
    function: Callable[..., object], x: Array, package: str = "loopcal"
) -> Array:
    """Forward-mode derivative (..., k) of a function at x (k,), in double precision.

    The whole function is compiled at once, which takes a fraction of compiling it operation by
    operation; where it looks at the values it computes, which a compiled function cannot, it is run
    as it stands.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    slope, point = jax.jacfwd(function), jax.numpy.asarray(x)
    with under_jax(package):
        try:
            return np.asarray(compile_quickly(slope)(point))
        except (jax.errors.TracerBoolConversionError, jax.errors.NonConcreteBooleanIndexError,
                jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError):  # fmt: skip  # noqa: E501
            return np.asarray(slope(point))


def compile_quickly(function: Callable[..., object]) -> Callable[..., Any]:
    """Return a function of jax arrays, compiled once for each set of shapes, without the
    optimizations that take long.

    Versions of jax that do not know an option compile with their own ones.
    """
    import jax

    compiled: dict[tuple[tuple[int, ...], ...], Callable[..., Any]] = {}

    def call(*arguments: ArrayLike) -> Any:
        shapes = tuple(np.shape(argument) for argument in arguments)
        if shapes not in compiled:
            lowered = jax.jit(function).lower(*arguments)
            try:
                compiled[shapes] = lowered.compile(compiler_options=_QUICK_COMPILATION)
            except jax.errors.JaxRuntimeError:
                compiled[shapes] = lowered.compile()
        return compiled[shapes](*arguments)

    return call


class _Either:
    """A numpy module whose functions are jax's if an argument is a jax array, else numpy's."""

    def __init__(self, plain: ModuleType, traced: ModuleType) -> None:
        self._plain, self._traced = plain, traced

    def __getattr__(self, name: str) -> object:
        import jax

        plain = getattr(self._plain, name)
        if isinstance(plain, ModuleType):
            return _Either(plain, getattr(self._traced, name))
        if isinstance(plain, type) or not callable(plain):
            return plain

        def either(*args: object, **kwargs: object) -> object:
            arrays = (a for a in jax.tree.leaves((args, kwargs)) if isinstance(a, jax.Array))
            return (
                plain(*args, **kwargs)
                if next(arrays, None) is None
                else getattr(self._traced, name)(*args, **kwargs)
            )

        return either


@contextmanager
def under_jax(package: str = "loopcal") -> Iterator[None]:
    """Let every loaded module of a package find jax.numpy under the name `np`, and put numpy back
    at the end.

    What does not depend on the traced unknowns stays with numpy: it needs no derivative and no
    compiling. `stack_matrix` and `stack_blocks` write into an array, which jax does not allow, so
    they are replaced too. Poses are compared by loopcal.geometry, whatever the engine.
    """
    import jax.numpy

    from loopcal import engine
    from loopcal import geometry as rotations

    def stack(rows: tuple[tuple[Any, ...], ...]) -> Any:
        entries = jax.numpy.broadcast_arrays(*(entry for row in rows for entry in row))
        shape = (*entries[0].shape, len(rows), len(rows[0]))
        return jax.numpy.stack(entries, axis=-1).reshape(shape)

    def join(rows: tuple[tuple[Any, ...], ...]) -> Any:
        blocks = [block for row in rows for block in row if block is not None]
        leading = np.broadcast_shapes(*(block.shape[:-2] for block in blocks))
        heights = [next(b.shape[-2] for b in row if b is not None) for row in rows]
        widths = [next(b.shape[-1] for b in c if b is not None) for c in zip(*rows, strict=True)]
        return jax.numpy.concatenate(
            [
                jax.numpy.concatenate(
                    [
                        jax.numpy.broadcast_to(0.0 if b is None else b, (*leading, height, width))
                        for b, width in zip(row, widths, strict=True)
                    ],
                    axis=-1,
                )
                for row, height in zip(rows, heights, strict=True)
            ],
            axis=-2,
        )

    replaced = {"stack_matrix": stack, "stack_blocks": join}
    functions, compare_poses = cast(dict[str, Any], vars(engine)), engine.compare_poses

    modules = [
        module
        for name, module in list(sys.modules.items())
        if (name == package or name.startswith(package + ".")) and getattr(module, "np", None) is np
    ]
    stacking = [
        (vars(module), name, getattr(rotations, name))
        for module in modules
        for name in replaced
        if hasattr(module, name)
    ]
    for module in modules:
        vars(module)["np"] = _Either(np, jax.numpy)
    for names, name, _ in stacking:
        names[name] = replaced[name]
    functions["compare_poses"] = lambda *_: None
    try:
        yield
    finally:
        functions["compare_poses"] = compare_poses
        for module in modules:
            vars(module)["np"] = np
        for names, name, own in stacking:
            names[name] = own
