"""The graph of one frame, run on each frame of a batch, in operators of which Inductor makes fast loops.

What Inductor (torch 2.13) makes slow on a CPU is written anew here, with the same results. Where the batch is free, many loops
have the batch innermost, and a single frame runs without vectors. Bool masks are loaded, stored and converted to uint8 element by
element. A field of one channel passes for a channels-last image, so that what is joined from such fields, and all that is
computed from that, has its channels interleaved.
"""

import operator

import torch
from torch import Tensor, fx, nn

from ..pipeline import DepthPipeline
from .trace import size_and_dtype, trace_one_frame, traced

AND = (torch.ops.aten.__and__.Tensor, torch.ops.aten.bitwise_and.Tensor, torch.ops.aten.logical_and.default)
OR = (torch.ops.aten.__or__.Tensor, torch.ops.aten.bitwise_or.Tensor, torch.ops.aten.logical_or.default)
NOT = (torch.ops.aten.bitwise_not.default, torch.ops.aten.logical_not.default)
VIEWS = (torch.ops.aten.slice.Tensor, torch.ops.aten.index_select.default)
"""Operators on masks that have a twin on zeros and ones."""


class EachFrame(nn.Module):
    """A program of one frame (1, 3, H, W), run on each frame of a batch (B, 3, H, W).

    Args:
        of_one: the program, or any module that returns a tuple of tensors with one frame each.
    """

    def __init__(self, of_one: nn.Module) -> None:
        super().__init__()
        self.of_one = of_one

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        from torch._higher_order_ops.map import map as map_each

        def one(image: Tensor, *_: object) -> tuple[Tensor, ...]:
            return tuple(out[0] for out in self.of_one(image[None]))

        return tuple(map_each(one, images))


def trace_each_frame(pipe: DepthPipeline) -> torch.export.ExportedProgram:
    """Trace a copy of a pipeline for any batch, as a loop over its frames.

    Args:
        pipe: the pipeline.
    Returns:
        a program with the outputs of :func:`trace`, equal bit for bit to those of each frame alone.
    """
    of_one = trace_one_frame(pipe)
    convert_masks_at_once(of_one.graph_module)
    hold_masks_as_floats(of_one.graph_module)
    join_channels_as_rows(of_one.graph_module)
    height, width, dtype = size_and_dtype(pipe)
    images = torch.full((2, 3, height, width), 0.5, dtype=dtype)
    module = of_one.module()
    assert isinstance(module, fx.GraphModule)
    hold_complex_as_real(module)
    return traced(EachFrame(module), images, any_batch=True)


def convert_masks_at_once(graph_module: fx.GraphModule) -> None:
    """Bool masks that become float by way of uint8 become float at once."""
    graph, to, check = graph_module.graph, torch.ops.aten.to.dtype, torch.ops.aten._assert_tensor_metadata.default
    for node in graph.find_nodes(op="call_function", target=to):
        mask = node.args[0]
        if node.args[1] != torch.uint8 or mask.meta["val"].dtype != torch.bool:
            continue
        for user in list(node.users):
            if user.target is to and user.args[1].is_floating_point:
                user.replace_input_with(node, mask)
        if all(user.target is check for user in node.users):  # of its dtype
            for unused in (*node.users, node):
                graph.erase_node(unused)
    graph_module.recompile()


def hold_masks_as_floats(graph_module: fx.GraphModule) -> None:
    """Masks become zeros and ones: and is a product, or a maximum, not a difference from one.

    What still needs a bool compares the float with one half. Masks that an operator writes to stay as they are.
    """
    graph, aten = graph_module.graph, torch.ops.aten
    for check in graph.find_nodes(op="call_function", target=aten._assert_tensor_metadata.default):
        graph.erase_node(check)  # of the dtype before a conversion
    masks = [node for node in graph.nodes if node.op == "call_function" and _is_mask(node) and not _is_written(node)]
    floats: dict[fx.Node, fx.Node] = {}
    for mask in masks:
        with graph.inserting_after(mask):
            floats[mask] = _as_float(graph, mask, floats)
    made = set(floats.values())
    for mask, zero_one in floats.items():
        half = None
        for user in list(mask.users):
            if user in made or (user in floats and user.target in (*AND, *OR, *NOT, *VIEWS)):
                continue
            if user.target is aten.to.dtype and user.args[1] == torch.float32:
                user.replace_all_uses_with(zero_one)
                graph.erase_node(user)
                continue
            if half is None:
                with graph.inserting_after(zero_one):
                    half = graph.call_function(aten.gt.Scalar, (zero_one, 0.5))
                    half.meta["val"] = mask.meta["val"]
            user.replace_input_with(mask, half)
    for mask in reversed(masks):
        if not mask.users:
            graph.erase_node(mask)
    graph_module.recompile()


def _is_mask(node: fx.Node) -> bool:
    """Whether a node of the graph is a bool tensor."""
    held = node.meta.get("val")
    return isinstance(held, Tensor) and held.dtype == torch.bool


def _is_written(node: fx.Node) -> bool:
    """Whether an operator writes to a tensor, or to a view of it."""
    for user in node.users:
        schema = getattr(user.target, "_schema", None)  # of operators of torch; other functions are Python's
        if schema is not None and schema.is_mutable:
            return True
        if user.target in (torch.ops.aten.slice.Tensor, torch.ops.aten.select.int) and _is_written(user):
            return True
    return False


def _as_float(graph: fx.Graph, mask: fx.Node, floats: dict[fx.Node, fx.Node]) -> fx.Node:
    """A mask in zeros and ones, from those of what it is made of where these are known."""
    aten = torch.ops.aten
    made_of = [floats.get(part) for part in mask.args if isinstance(part, fx.Node) and _is_mask(part)]
    if made_of and all(part is not None for part in made_of):
        if mask.target in AND:
            return graph.call_function(aten.mul.Tensor, tuple(made_of))
        if mask.target in OR:
            return graph.call_function(aten.maximum.default, tuple(made_of))
        if mask.target in NOT:
            return graph.call_function(aten.rsub.Scalar, (made_of[0], 1.0))
        if mask.target in VIEWS:
            return graph.call_function(mask.target, (made_of[0], *mask.args[1:]))
    return graph.call_function(aten.to.dtype, (mask, torch.float32))


def hold_complex_as_real(graph_module: fx.GraphModule) -> None:
    """Complex tables become pairs of real numbers: Inductor compiles no loop over frames that reads complex ones."""
    graph = graph_module.graph
    for node in graph.find_nodes(op="get_attr"):
        table = operator.attrgetter(node.target)(graph_module)
        if not isinstance(table, Tensor) or not table.is_complex():
            continue
        name = f"{node.name}_pairs"
        graph_module.register_buffer(name, torch.view_as_real(table).clone())
        with graph.inserting_before(node):
            pairs = graph.create_node("get_attr", name)
            node.replace_all_uses_with(graph.call_function(torch.ops.aten.view_as_complex.default, (pairs,)))
        graph.erase_node(node)
    graph_module.recompile()


def join_channels_as_rows(graph_module: fx.GraphModule) -> None:
    """Channels (B, C, H, W) are joined as rows (B, C * H, W)."""
    graph, aten = graph_module.graph, torch.ops.aten
    for node in graph.find_nodes(op="call_function", target=aten.cat.default):
        out = node.meta["val"]
        if out.dim() != 4 or node.args[1:] not in ((1,), (-3,)) or not all(isinstance(size, int) for size in out.shape):
            continue  # of any size: pixels picked from an image
        with graph.inserting_before(node):
            rows = [graph.call_function(aten.reshape.default, (part, [out.shape[0], -1, out.shape[3]])) for part in node.args[0]]
            joined = graph.call_function(aten.cat.default, (rows, 1))
            node.replace_all_uses_with(graph.call_function(aten.reshape.default, (joined, list(out.shape))))
        graph.erase_node(node)
    graph_module.recompile()
