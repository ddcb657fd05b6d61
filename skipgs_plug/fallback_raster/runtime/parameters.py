"""Parameters of kernels: arrays and numbers, by themselves or grouped in structs that Python and C++ know by one name.

A struct is a `NamedTuple` whose fields are annotated like the parameters of a kernel. Python passes one of its
instances, C++ receives a `struct` of the same name with the same fields. A kernel of thirty tensors has ten parameters.
"""

import inspect
from collections.abc import Callable, Iterator
from typing import Annotated, Any, NamedTuple, TypeAlias, get_args, get_origin, get_type_hints

import torch
from torch import Tensor


class ArrayKind(NamedTuple):
    """A contiguous tensor on the CPU, which a kernel sees as a pointer."""

    dtype: torch.dtype
    element: str  # in C++

    @property
    def cpp(self) -> str:
        """The parameter's type in C++."""
        return f"{self.element}*"


# Annotate `Annotated[FloatArray, "n, 3"]` to declare the size, too (`guard.Sizes`). A kernel reads an array and writes
# an output; the compiler refuses to write into an array.
FloatArray: TypeAlias = Annotated[Tensor, ArrayKind(torch.float32, "const float")]
IntArray: TypeAlias = Annotated[Tensor, ArrayKind(torch.int32, "const int")]
LongArray: TypeAlias = Annotated[Tensor, ArrayKind(torch.int64, "const long long")]
ByteArray: TypeAlias = Annotated[Tensor, ArrayKind(torch.uint8, "const unsigned char")]
FloatOutput: TypeAlias = Annotated[Tensor, ArrayKind(torch.float32, "float")]
IntOutput: TypeAlias = Annotated[Tensor, ArrayKind(torch.int32, "int")]
LongOutput: TypeAlias = Annotated[Tensor, ArrayKind(torch.int64, "long long")]

# Numbers, whose types in Warp and C++ have 32 bits. Arrays travel to Warp as addresses: describing them takes longer
# than some kernels run.
_NUMBERS = {int: "int", float: "float"}
_WARP = {int: "wp.int32", float: "wp.float32"}


class Field(NamedTuple):
    """One array or number of a kernel."""

    path: str  # "n", or "camera.width" for the field of a struct
    kind: ArrayKind | type
    shape: str | None  # declared size of an array

    @property
    def symbol(self) -> str:
        """Name of the parameter that Warp passes it in."""
        return self.path.replace(".", "_") + ("_address" if isinstance(self.kind, ArrayKind) else "")

    @property
    def warp(self) -> str:
        """Type of that parameter."""
        return "wp.uint64" if isinstance(self.kind, ArrayKind) else _WARP[self.kind]

    @property
    def cpp(self) -> str:
        """Its type in C++."""
        return self.kind.cpp if isinstance(self.kind, ArrayKind) else _NUMBERS[self.kind]

    @property
    def value(self) -> str:
        """C++ expression that makes it of Warp's parameter."""
        return f"({self.cpp}){self.symbol}"


class Parameter(NamedTuple):
    """A parameter of a kernel: a field, or a struct of several."""

    name: str
    struct: type | None
    fields: tuple[Field, ...]

    @property
    def definition(self) -> str:
        """C++ that defines it from Warp's parameters."""
        if self.struct is None:
            (field,) = self.fields
            # A number is Warp's parameter itself.
            return f"{field.cpp} const {self.name} = {field.value};\n" if field.symbol != self.name else ""
        values = ", ".join(field.value for field in self.fields)
        return f"const {self.struct.__name__} {self.name} = {{{values}}};\n"


def parameters_of(stub: Callable[..., Any]) -> tuple[Parameter, ...]:
    """The parameters that a stub declares."""
    hints = get_type_hints(stub, include_extras=True)
    return tuple(_parameter(name, hints[name]) for name in inspect.signature(stub).parameters)


def structs_of(parameters: tuple[Parameter, ...]) -> list[type]:
    """The structs among the parameters, each once."""
    return list(dict.fromkeys(p.struct for p in parameters if p.struct is not None))


def declare_struct(struct: type) -> str:
    """C++ that declares a struct."""
    fields = "".join(
        f"    {field.cpp} {field.path};{f'  // [{field.shape}]' if field.shape else ''}\n"
        for field in _fields(struct, "")
    )
    return f"struct {struct.__name__} {{\n{fields}}};\n"


def flattener(
    name: str, stub: Callable[..., Any], parameters: tuple[Parameter, ...], refuse: Callable[[str, Any], None]
) -> Callable[..., tuple[Any, ...]]:
    """Makes a function of the stub's parameters that returns their fields, one after the other.

    Python checks the names of the arguments; `refuse(name, argument)` is called with what is not the declared struct.
    """
    checks = "".join(
        f"    if type({p.name}) is not {p.struct.__name__}: refuse({p.name!r}, {p.name})\n"
        for p in parameters
        if p.struct is not None
    )
    by_name = any(p.kind is p.KEYWORD_ONLY for p in inspect.signature(stub).parameters.values())
    names = ["*"] * by_name + [p.name for p in parameters]
    values = "".join(f"*{p.name}, " if p.struct else f"{p.name}, " for p in parameters)
    source = f"def {name}({', '.join(names)}):\n{checks}    return ({values})\n"
    namespace: dict[str, Any] = {struct.__name__: struct for struct in structs_of(parameters)} | {"refuse": refuse}
    exec(source, namespace)
    made: Callable[..., tuple[Any, ...]] = namespace[name]
    return made


def address_reader(fields: list[Field]) -> Callable[[tuple[Any, ...]], list[int | float] | None]:
    """Makes a function that turns the fields of a call into addresses of tensors, and numbers.

    It returns None if a field is not of its kind. Written out field by field, it takes half the time of a loop.
    """
    names = [f"f{i}" for i in range(len(fields))]
    namespace: dict[str, Any] = {"SMALLEST": -(2**31), "LARGEST": 2**31 - 1}
    conditions, values = [], []
    for i, (name, field) in enumerate(zip(names, fields, strict=True)):
        if isinstance(field.kind, ArrayKind):
            namespace[f"dtype{i}"] = field.kind.dtype
            fits = f"{name}.dtype is dtype{i} and {name}.is_cpu and {name}.is_contiguous()"
            # A tensor without an address is a tensor by name, which keeps its numbers elsewhere, unless it is empty.
            conditions.append(f"{fits} and ((a{i} := {name}.data_ptr()) or not {name}.numel())")
            values.append(f"a{i}")
        else:
            in_range = f" and SMALLEST <= {name} <= LARGEST" if field.kind is int else ""
            conditions.append(f"type({name}) is {field.kind.__name__}{in_range}")
            values.append(name)
    source = f"""def read(arguments):
    ({"".join(f"{name}, " for name in names)}) = arguments
    try:
        if {" and ".join(f"({condition})" for condition in conditions) or True}:
            return [{", ".join(values)}]
    except AttributeError:
        pass
    return None
"""
    exec(source, namespace)
    made: Callable[[tuple[Any, ...]], list[int | float] | None] = namespace["read"]
    return made


def _parameter(name: str, annotation: Any) -> Parameter:
    if isinstance(annotation, type) and issubclass(annotation, tuple):
        return Parameter(name, annotation, tuple(_fields(annotation, f"{name}.")))
    return Parameter(name, None, (_field(name, annotation),))


def _fields(struct: type, prefix: str) -> Iterator[Field]:
    for name, annotation in get_type_hints(struct, include_extras=True).items():
        yield _field(prefix + name, annotation)


def _field(path: str, annotation: Any) -> Field:
    if get_origin(annotation) is not Annotated:
        return Field(path, annotation, None)
    _, kind, *shape = get_args(annotation)
    return Field(path, kind, *shape or [None])
