"""The functions of :mod:`strapdown.kernels.argument_tables` for numba."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


@intrinsic  # type: ignore[untyped-decorator]
def unpacked(typing: Any, kind: Any, table: Any) -> Any:
    """Read a value from a table of integers."""

    def lower(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        integers = cgutils.create_struct_proxy(table)(target, builder, values[1]).data
        place = iter(range(1 << 20))

        def read(form: Any) -> Any:
            if isinstance(form, types.BaseTuple):
                return target.make_tuple(builder, form, [read(part) for part in form])
            integer = builder.load(builder.gep(integers, [ir.Constant(ir.IntType(64), next(place))]))
            if isinstance(form, types.Array):
                element = target.get_data_type(form.dtype).as_pointer()
                shape = [read(types.intp) for _ in range(form.ndim)]
                model = target.data_model_manager[form]
                return model.from_argument(builder, (builder.inttoptr(integer, element), shape))
            return builder.bitcast(integer, target.get_value_type(form))

        return read(signature.return_type)

    return kind.instance_type(kind, table), lower


@intrinsic  # type: ignore[untyped-decorator]
def call(typing: Any, address: Any, arguments: Any, like: Any) -> Any:
    """Call the machine code at an address."""

    def lower(target: Any, builder: Any, signature: Any, values: Any) -> Any:
        convention, parameters = target.call_conv, list(arguments)
        result = like if len(like) > 1 else like[0] if len(like) else types.none
        kind = convention.get_function_type(result, parameters)
        parts = cgutils.unpack_tuple(builder, values[1], len(parameters))
        returned = cgutils.alloca_once(builder, kind.args[0].pointee)
        error = cgutils.alloca_once(builder, kind.args[1].pointee)
        function = builder.inttoptr(values[0], kind.as_pointer())
        flat = convention._get_arg_packer(parameters).as_arguments(builder, parts)
        builder.call(function, [returned, error, *flat])  # kernels raise nothing
        packer = target.data_model_manager[result]
        value = packer.from_return(builder, builder.load(returned))
        return value if len(like) > 1 else target.make_tuple(builder, like, [value] * len(like))

    return like(address, arguments, like), lower


INTRINSICS = {"unpacked": unpacked, "call": call}
