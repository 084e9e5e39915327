"""Kernels as other kernels call them: without machine code of their own.

Numba makes machine code of every function that is called, by itself and again in each of its callers, down to the outermost. Kernels that call each
other through six functions are then compiled six times. Here a callee becomes code for the optimiser only, and the kernel that Python calls becomes
machine code with all that it calls. Numba's own library functions are made this way (``compile_subroutine``).

A callee is optimised before it is linked into its callers, so that what is small becomes simple before it is copied. That ends with the sweep along
the tubes, in which nearly all the time goes: what calls it is left to the outermost kernel, as optimising the sweep with each of them again would
take long and change little.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.core import codegen, compiler, registry, typed_passes
from numba.core.compiler_machinery import PassManager, register_pass

_large: set[Callable[..., Any]] = set()  # functions whose callers are not optimised by themselves


class _Linked(codegen.JITCodeLibrary):
    """Code that is linked into others and never run by itself; ``large`` where its callers are not optimised by themselves."""

    large = False

    def finalize(self) -> None:
        """Link the callees in, and optimise unless one is large."""
        self._raise_if_finalized()
        left = False
        to_run = getattr(self, "_reload_init", set())  # when it is loaded; older numba has none
        for library in dict.fromkeys(self._linking_libraries):
            left |= getattr(library, "large", False)
            to_run |= getattr(library, "_reload_init", set())
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        if left:
            self.large = True
        else:
            self._optimize_final_module()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _CalleeLowering(typed_passes.NativeLowering):
    """Lowering without machine code."""

    def run_pass(self, state: Any) -> bool:
        """Lower the function of ``state`` into a library of its own."""
        target = state.targetctx
        state.library = _Linked(target.codegen(), state.func_id.func_qualname)
        state.library.large = state.func_id.func in _large
        state.flags.no_compile = state.flags.no_cpython_wrapper = state.flags.no_cfunc_wrapper = True
        super().run_pass(state)
        entry = object()  # by which callers find it
        target.insert_user_function(entry, state["cr"].fndesc, [state.library])
        state["cr"] = state["cr"]._replace(cfunc=entry)
        return True


class _CalleeCompiler(compiler.CompilerBase):
    """Numba's stages, with the lowering of a callee."""

    def define_pipelines(self) -> list[PassManager]:
        """The one pipeline."""
        builder, whole = compiler.DefaultPassBuilder, PassManager("callee")
        for stage in (
            builder.define_untyped_pipeline,
            builder.define_typed_pipeline,
            builder.define_nopython_lowering_pipeline,
        ):
            for one, words in stage(self.state).passes:
                whole.add_pass(_CalleeLowering if one is typed_passes.NativeLowering else one, words)
        whole.finalize()
        return [whole]


class _Callee(registry.CPUDispatcher):
    """A function as kernels call it, by the types of its arguments."""

    def add_overload(self, cres: Any) -> None:
        """Keep one. There is nothing that Python could call."""
        self.overloads[tuple(cres.signature.args)] = cres


def call_without_machine_code(
    compiled: Any, function: Callable[..., Any], options: dict[str, Any], large: bool
) -> None:
    """Have other kernels call ``function`` as this module says. Python goes on to call its dispatcher ``compiled``.

    Args:
        options: of numba, as ``compiled`` has them.
        large: whether callers of it are left to the outermost kernel.
    """
    if large:
        _large.add(function)
    callee = _Callee(function, targetoptions={"nopython": True, **options}, pipeline_class=_CalleeCompiler)
    compiled.get_call_template, compiled.get_overload = callee.get_call_template, callee.get_overload
