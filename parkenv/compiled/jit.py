"""Compile functions with numba, and keep the code until any of its sources changes.

Numba offers `njit(cache=True)` with `NUMBA_CACHE_DIR`, or a cache locator, for this. It is not used because its key is
the file of the function alone: callers would keep running the old code of what they call, variants of one function with
other options would share a file, two processes would compile the same, and a file that others wrote would be run.

Numba optimises every function with all that it calls and makes machine code of it at once. Here that happens only for
functions that Python calls (`_Library`): what only compiled code calls would be optimised and made again with each of
its callers, which takes longer than everything else.
"""

import functools
import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FunctionType
from typing import Any, overload

import numba
import numpy as np
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.cpu import CPUTargetOptions
from numba.core.environment import lookup_environment
from numba.core.options import TargetOptions
from numba.core.registry import CPUDispatcher, cpu_target
from numba.core.sigutils import normalize_signature
from numba.core.targetconfig import ConfigStack
from numba.core.types.misc import unliteral

from parkenv.compiled.clock import counted
from parkenv.compiled.code_files import CodeFiles
from parkenv.errors import require

require(
    not numba.config.DISABLE_JIT, "NUMBA_DISABLE_JIT is set, want it unset: parkenv runs compiled code only"
)

# Numba has this flag for its own parallel loops, and no option for it.
CPUTargetOptions.noalias = TargetOptions.Mapping("noalias")


@overload
def compiled(function: Callable[..., Any], /) -> Any: ...
@overload
def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]: ...
def compiled(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:
    """Compile the decorated function on its first call, once for all processes and sessions.

    A function that Python calls returns no named tuple: numba makes one by calling Python, which is slow, and the
    process crashes if a signal handler, such as that of Ctrl-C, raises an exception there.

    Args:
        function: the function, if the decorator has no options.
        options: options of `numba.njit`, except `cache`; and two of our own for loops that the compiler is to turn into
            vector instructions: `single=True` makes the float literals of the function single precision, and
            `distinct=True` promises that no two arrays among the arguments overlap. By default C cannot call the
            function (`no_cfunc_wrapper`).

    Examples:
        >>> @compiled(error_model="numpy")
        ... def half(x):
        ...     return x / 2
        >>> half.py_func(3.0)
        1.5
    """
    if function is None:
        return functools.partial(_compiled, **options)
    return _compiled(function, **options)


def _compiled(
    function: Callable[..., Any], single: bool = False, distinct: bool = False, **options: Any
) -> Any:
    if single:
        function = _with_single_literals(function)
    if distinct:
        options["noalias"] = True
    # Numba's wrapper for calls from C takes a tenth of the time of compiling, and next to nobody calls it.
    options = {"nopython": True, "boundscheck": None, "no_cfunc_wrapper": True, **options}
    outer = _Function(function, targetoptions=options)
    outer.inner = _KeptFunction(function, targetoptions=options | {"no_cpython_wrapper": True})
    if Path(function.__code__.co_filename).is_file():
        for dispatcher in (outer, outer.inner):
            dispatcher._cache = CodeFiles(function, dispatcher.targetoptions | {"single": single})
    return outer


def _with_single_literals(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with float32 in place of its float literals: one float64 makes a whole expression float64."""
    code = function.__code__
    literals = tuple(np.float32(value) if type(value) is float else value for value in code.co_consts)
    single = FunctionType(code.replace(co_consts=literals), function.__globals__, function.__name__)
    single.__defaults__ = function.__defaults__
    return functools.update_wrapper(single, function)


def entry_point(function: Any, *like: Any) -> Any:
    """Return the code of a compiled function for arguments of the types of some examples, as Python calls it.

    A call of the function itself looks up these types first, which takes 80 ns.
    """
    return function.compile(tuple(map(numba.typeof, like))) if isinstance(function, _Function) else function


class _KeptFunction(CPUDispatcher):  # type: ignore[misc]
    """A function with code for each combination of types; only one process compiles it at a time."""

    def compile(self, sig: Any) -> Any:
        """Load or compile the function for a signature; returns what Python can call."""
        types = tuple(normalize_signature(sig)[0])
        if types in self.overloads:
            return self.overloads[types].entry_point
        alone = self._cache.alone(types) if isinstance(self._cache, CodeFiles) else nullcontext()
        with global_compiler_lock, counted(), alone, _uncollected(), _late_machine_code():
            return super().compile(types)


@contextmanager
def _uncollected() -> Iterator[None]:
    """Keep the garbage collector from looking through all that compiling has made, a tenth of its time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class _Function(_KeptFunction):
    """As Python calls it. Compiled code calls `inner`, which has neither machine code nor wrapper of its own."""

    inner: Any

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return the types of a call by compiled code.

        A constant, or a variable whose first value is one, has its own type in numba; for each the function and all
        that it calls would be compiled again, so `f(0)` and `f(n)` share one version here.
        """
        values = {name: unliteral(kind) for name, kind in dict(kws).items()}
        return self.inner.get_call_template(tuple(unliteral(kind) for kind in args), values)

    def get_overload(self, sig: Any) -> Any:
        return self.inner.get_overload(sig)

    @property
    def is_compiling(self) -> Any:
        return self._compiling_counter or self.inner.is_compiling


class _Library(JITCodeLibrary):  # type: ignore[misc]
    """The code of a function for LLVM; machine code from the first time that its address is asked for."""

    _optimized = _made = False

    def _finalize_final_module(self) -> None:
        if self._object_caching_enabled and self._compiled_object:
            self._make()  # from a file
        else:
            self._finalize_dynamic_globals()
            self._verify_declare_only_symbols()
            self._finalized = True

    def _optimize_functions(self, ll_module: Any) -> None:
        """Tidy up each function lightly; numba does it at full length, and for mere declarations, too."""
        if _before_callers():
            super()._optimize_functions(ll_module)
            return
        ll_module.data_layout = self.codegen._data_layout
        passes, builder = self.codegen._function_pass_manager(opt=1)
        for function in ll_module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    def _optimize_final_module(self, at_once: bool = False) -> None:
        if not self._optimized and (at_once or _before_callers()):
            super()._optimize_final_module()
            self._optimized = True

    def _make(self) -> None:
        super()._finalize_final_module()
        self._made = True
        for variable in self._final_module.global_variables:
            environment = lookup_environment(variable.name)
            if environment is not None:
                self.codegen.set_env(variable.name, environment)

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        if not self._made:
            try:
                self._final_module.get_function(name)
            except NameError:
                return 0
            self._optimize_final_module(at_once=True)
            self._make()
        return int(super().get_pointer_to_function(name))

    def serialize_using_object_code(self) -> tuple[str, str, Any]:
        self._ensure_finalized()
        if self._made:
            state: tuple[str, str, Any] = super().serialize_using_object_code()
            return state
        return self.name, "bitcode", self._get_module_for_linking().as_bitcode()


def _before_callers() -> bool:
    """Return whether the function that numba compiles now is optimised before its callers are, as numba does.

    With `fastmath` the order decides to what results are rounded; and numba strikes out counting of references (`_nrt`)
    best before functions grow.
    """
    flags = ConfigStack.top_or_none()
    return flags is None or bool(flags.fastmath) or flags.nrt


@contextmanager
def _late_machine_code() -> Iterator[None]:
    """Let numba make `_Library`s, of what it compiles or loads for us; the user's own functions are numba's."""
    codegen = cpu_target.target_context.codegen()
    library_class, set_env = codegen._library_class, codegen.set_env

    def set_existing_env(name: str, environment: Any) -> None:
        # What a function without machine code needs from Python is set when it has some.
        if codegen._engine.is_symbol_defined(name):
            set_env(name, environment)

    codegen._library_class, codegen.set_env = _Library, set_existing_env
    try:
        yield
    finally:
        codegen._library_class, codegen.set_env = library_class, set_env


# For functions that make no arrays: counting references to those that they are given would take most of their time.
kernel = compiled(error_model="numpy", _nrt=False)
inlined = compiled(error_model="numpy", _nrt=False, forceinline=True)
