"""Optimised machine code of a function only where Python calls it.

Numba optimises every function with all that it calls and makes machine code of it at once. What only compiled code
calls is then optimised and made again with each of its callers, which takes longer than everything else.
"""

from __future__ import annotations

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.environment import lookup_environment
from numba.core.registry import cpu_target
from numba.core.targetconfig import ConfigStack


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
        """Return the address of a function, or 0 if the library does not define it."""
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
        """Return what is kept in a file."""
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


def make_code_late() -> None:
    """Let numba make machine code only when it is needed, from now on in this process."""
    codegen = cpu_target.target_context.codegen()
    set_now = codegen.set_env

    def set_env(name: str, environment: Any) -> None:
        # What a function without machine code needs from Python is set when it has some.
        if codegen._engine.is_symbol_defined(name):
            set_now(name, environment)

    codegen._library_class, codegen.set_env = _Library, set_env
