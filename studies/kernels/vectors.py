"""Loops for vectors of cases, in two ways; `cpu` chooses by the processor.

`MaskedWriter`, for AVX-512: all of a sample in one piece. Stores leave frozen cases out, and an
instruction spreads a known number over the vector as it reads it.

`CalledWriter`, for all others: code that is small enough for the instruction cache, and plain
stores. `run` calls `sample` once a sample, which calls the routines of the loop. A sample reads
the state from one buffer and writes it to another; where a case is frozen, which is rare, its old
numbers are put back. Known numbers lie in memory as whole vectors, each once.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from typing import Any

from studies.kernels.graph import Node, is_known
from studies.kernels.llvm import Arguments, Writer, ir
from studies.kernels.traced import Body, Change, TracedLoop

#: Bytes that buffers begin at multiples of: a vector of the widest processor.
ALIGNMENT = 64


class VectorWriter(Writer):
    """Writes `run(leaves, n_steps, lanes, first)`; the first leaf holds the known numbers."""

    def __init__(self, loop: TracedLoop, width: int, triple: str) -> None:
        """
        Args:
            loop: what to write.
            width: cases in a vector.
            triple: LLVM's name for the kind of processor.
        """
        super().__init__(loop, width)
        self._triple = triple

    @property
    def numbers(self) -> list[float]:
        """What the first leaf must hold, once all is written."""
        raise NotImplementedError

    def open(self) -> Arguments:
        pointer = ir.PointerType()
        signature = ir.FunctionType(ir.VoidType(), [pointer, self.index, self.index, self.index])
        function = ir.Function(self.module, signature, "run")
        function.attributes.add("nounwind")
        leaves, n_steps, lanes, first = function.args
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self._mode = self._flush_to_zero()
        self._table = self._base(leaves, 0)
        return self._arguments(leaves, n_steps, lanes, first)

    def close(self) -> None:
        if self._mode is not None:
            self._control(*self._mode)
        super().close()

    def _arguments(self, leaves: Any, n_steps: Any, lanes: Any, first: Any) -> Arguments:
        bases, k = {}, 1
        for kind, part in self.loop.leaves.items():
            bases[kind] = [self._base(leaves, k + n) for n in range(len(part))]
            k += len(part)
        return Arguments({**bases, "result": bases["state"]}, n_steps, lanes, first)

    def _base(self, leaves: Any, k: int) -> Any:
        place = self.builder.gep(
            leaves, [ir.Constant(self.index, k)], source_etype=ir.PointerType()
        )
        return self.builder.load(place, typ=ir.PointerType())

    def _flush_to_zero(self) -> Any:
        """How to restore the processor's mode; until then numbers too small to be normal become 0.

        Working with them takes a hundred times as long, and sums in single precision meet them.
        """
        if self._triple.startswith("x86_64"):
            word = ir.IntType(32)
            old, new = self.builder.alloca(word), self.builder.alloca(word)
            self._control("x86.sse.stmxcsr", old)
            mode = self.builder.load(old, typ=word)
            self.builder.store(self.builder.or_(mode, ir.Constant(word, 0x8040)), new)
            self._control("x86.sse.ldmxcsr", new)
            return "x86.sse.ldmxcsr", old
        if self._triple.startswith("aarch64"):
            mode = self._call("llvm.aarch64.get.fpcr", self.index)
            flushing = self.builder.or_(mode, ir.Constant(self.index, 1 << 24))
            self._control("aarch64.set.fpcr", flushing)
            return "aarch64.set.fpcr", mode
        return None

    def _control(self, name: str, value: Any) -> None:
        self._call(f"llvm.{name}", ir.VoidType(), value)


class MaskedWriter(VectorWriter):
    """One piece of code, masked stores."""

    def __init__(self, loop: TracedLoop, width: int, triple: str) -> None:
        super().__init__(loop, width, triple)
        self._used: list[float] = [0.0]

    @property
    def numbers(self) -> list[float]:
        return self._used

    def _store(self, change: Change, slot: Any) -> None:
        if is_known(change.mask):
            super()._store(change, slot)
            return
        name = f"llvm.masked.store.v{self.width}f{8 * self.bytes}.p0"
        alignment = ir.Constant(ir.IntType(32), self.bytes * self.width)
        value, mask = self._broadcast(change.value), self._broadcast(change.mask)
        self._call(name, ir.VoidType(), value, slot, alignment, mask)

    def _number(self, x: float) -> Any:
        """A known number, read anew at each use.

        LLVM would keep every one of them as a whole vector on the stack, more than the cache holds.
        One of its own in memory costs an instruction nothing: it is spread over the vector as it is
        read.
        """
        place = ir.Constant(self.index, len(self._used))
        self._used.append(x)
        place = self.builder.gep(self._table, [place], source_etype=self.scalar)
        return self.builder.load(place, align=self.bytes, typ=self.scalar)


class CalledWriter(VectorWriter):
    """A function for the sample and one for each routine, plain stores.

    Numbers that outlive a function lie in two buffers of the state and in `work`: first what is the
    same at every sample, then a frame for every call with its parameters and results.
    """

    def __init__(self, loop: TracedLoop, width: int, triple: str) -> None:
        super().__init__(loop, width, triple)
        self._known: dict[float, int] = {}  # place of each known number
        self._memory: dict[int, Any] = {}  # address of a node, by identity, in this function
        self._is_fixed = loop.fixed()
        self._fixed_at, self._shared_at, self._frame_at, self._work_size = self._layout()
        self._routines: dict[int, Any] = {}
        self._shared: set[int] = set()  # places of what has been written for all calls

    @property
    def numbers(self) -> list[float]:
        return [x for x in self._known for _ in range(self.width)] or [0.0]

    def write(self) -> Any:
        for k, (name, body) in enumerate(self.loop.bodies.items()):
            self._routines[name] = self._routine(k, name, body)
        sample, pointer = self._sample(), ir.PointerType()
        self._forget()
        arguments = self.open()
        function = self.builder.function
        leaves, n_steps, lanes, first = function.args
        at_state = self._places("state", "state", arguments)
        old, new, work = map(self._buffer, (len(at_state), len(at_state), self._work_size))
        for k, place in enumerate(at_state):
            value = self._load(place, True)
            self._keep(value, self._slot(old, k))
            self._keep(value, self._slot(new, k))
        self._prepare(self._places("constant", "constant", arguments), work)
        entry = self.builder.block
        loop, leave = map(function.append_basic_block, ("loop", "leave"))
        self.builder.branch(loop)

        self.builder.position_at_end(loop)
        number, from_, to = (self.builder.phi(kind) for kind in (self.index, pointer, pointer))
        row = self._row(number, n_steps)
        self.builder.call(sample, [leaves, lanes, first, row, from_, to, work, self._table])
        following = self.builder.add(number, ir.Constant(self.index, 1))
        begin = ir.Constant(self.index, 0)
        for phi, start, later in ((number, begin, following), (from_, old, to), (to, new, from_)):
            phi.add_incoming(start, entry)
            phi.add_incoming(later, loop)
        again = self.builder.icmp_signed("<", following, n_steps)
        self.builder.cbranch(again, loop, leave)

        self.builder.position_at_end(leave)
        for k, place in enumerate(self._places("state", "result", arguments)):
            self.builder.store(self._kept(self._slot(to, k)), place, align=self.bytes)
        self.close()
        return self.module

    def _prepare(self, at_constant: list[Any], work: Any) -> None:
        """Work out what is the same at every sample."""
        for node in self.loop.order:
            if not self._is_fixed[id(node)]:
                continue
            if node.operation == "read":
                self.values[id(node)] = self._load(at_constant[node.place[1]], node.is_varying)
            else:
                self._emit(node)
            if id(node) in self._fixed_at:
                self._keep(self._broadcast(node), self._slot(work, self._fixed_at[id(node)]))
        for node in self.loop.order:
            if node.operation == "call":
                self._give(node, work, is_fixed=True)

    # --- memory -----------------------------------------------------------------------------------

    def _layout(self) -> tuple[dict[int, int], dict[int, int], dict[int, int], int]:
        """Slots in `work`, and its size.

        They belong to what is the same at every sample, to what all calls of a routine share (the
        first one, by the routine), and to the calls' frames.
        """
        read = [x for body in self.loop.bodies.values() for x in body.fixed]
        read += [x for change in self.loop.changes for x in (change.mask, change.value)]
        read += self.loop.records
        for node in self.loop.order:
            if not self._is_fixed[id(node)] or node.is_truth:
                read += node.args
        fixed: dict[int, int] = {}
        for x in read:
            if not is_known(x) and self._is_fixed[id(x)] and not x.is_truth:
                fixed.setdefault(id(x), len(fixed))
        shared: dict[int, int] = {}
        frames, size = {}, len(fixed)
        for node in self.loop.order:
            if node.operation == "call":
                body, name = self.loop.bodies[id(node.place)], id(node.place)
                if name not in shared:
                    shared[name] = size
                    size += len(node.args) - body.n_parameters
                frames[id(node)] = size
                size += body.n_parameters + len(body.results)
        return fixed, shared, frames, size

    def _buffer(self, count: int) -> Any:
        stack = self.builder.alloca(self.vector, ir.Constant(self.index, max(count, 1)))
        stack.align = ALIGNMENT
        return stack

    def _slot(self, base: Any, k: int) -> Any:
        place = ir.Constant(self.index, k)
        return self.builder.gep(base, [place], source_etype=self.vector)

    def _narrow(self, x: Any) -> Any:
        if not is_known(x) and id(x) in self._memory:
            return self._kept(self._memory[id(x)])
        return super()._narrow(x)

    def _broadcast(self, x: Any) -> Any:
        if not is_known(x) or isinstance(x, bool) or x == 0:
            return super()._broadcast(x)
        k = self._known.setdefault(float(x), len(self._known))
        return self._kept(self._slot(self._table, k))

    # --- functions --------------------------------------------------------------------------------

    def _forget(self) -> None:
        """What a function knows, the next one does not."""
        self.values, self._memory = {}, {}

    def _begin(self, name: str, kinds: list[Any]) -> list[Any]:
        """Begin a function that others call; its arguments."""
        function = ir.Function(self.module, ir.FunctionType(ir.VoidType(), kinds), name)
        function.linkage = "internal"
        function.attributes.add("noinline")
        function.attributes.add("nounwind")
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self._forget()
        return list(function.args)

    def _routine(self, number: int, name: int, body: Body) -> Any:
        """`routine(frame, work, numbers)`: the frame has the parameters, then the results."""
        frame, work, self._table = self._begin(f"routine_{number}", [ir.PointerType()] * 3)
        due = defaultdict(list)
        for k, x in enumerate(body.results.values(), body.n_parameters):
            due[None if is_known(x) else id(x)].append((k, x))
        self._return(due[None], frame)
        for node in body.order:
            if node.operation != "read":
                self._emit(node)
            elif node.place[0] == "parameter":
                self._memory[id(node)] = self._slot(frame, node.place[1])
            elif node.place[0] == "shared":
                place = self._shared_at[name] + node.place[1]
                self._memory[id(node)] = self._slot(work, place)
            else:
                outer = body.fixed[node.place[1]]
                if is_known(outer):
                    self.values[id(node)] = self._broadcast(outer)
                else:
                    self._memory[id(node)] = self._slot(work, self._fixed_at[id(outer)])
            self._return(due[id(node)], frame)
        self.builder.ret_void()
        return self.builder.function

    def _return(self, results: Iterable[tuple[int, Any]], frame: Any) -> None:
        for k, x in results:
            self._keep(self._broadcast(x), self._slot(frame, k))

    def _sample(self) -> Any:
        """`sample(leaves, lanes, first, row, from, to, work, numbers)`."""
        pointer = ir.PointerType()
        kinds = [pointer, self.index, self.index, self.index, *[pointer] * 4]
        leaves, lanes, first, row, old, new, work, self._table = self._begin("sample", kinds)
        arguments = self._arguments(leaves, None, lanes, first)
        at_input = self._places("input", "input", arguments, row)
        due = defaultdict(list)
        for change in self.loop.changes:
            x = change.value
            due[None if is_known(x) or self._is_fixed[id(x)] else id(x)].append(change)
        for node in self.loop.order:
            if id(node) in self._fixed_at:
                self._memory[id(node)] = self._slot(work, self._fixed_at[id(node)])
        records = self._records(arguments, row, self._is_fixed)
        self._change(due[None], new)
        self._record(records[None])
        for node in self.loop.order:
            if not self._is_fixed[id(node)]:
                self._take(node, at_input, old, work)
            elif node.is_truth:
                self._emit(node)
            self._change(due[id(node)], new)
            self._record(records[id(node)])
        self._repair(old, new)
        self.builder.ret_void()
        return self.builder.function

    def _take(self, node: Node, at_input: list[Any], old: Any, work: Any) -> None:
        """One operation of a sample."""
        if node.operation == "call":
            body = self.loop.bodies[id(node.place)]
            self._give(node, work, is_fixed=False)
            for place, x in enumerate(
                node.args[body.n_parameters :], self._shared_at[id(node.place)]
            ):
                if place not in self._shared:
                    self._shared.add(place)
                    self._keep(self._broadcast(x), self._slot(work, place))
            frame = self._slot(work, self._frame_at[id(node)])
            self.builder.call(self._routines[id(node.place)], [frame, work, self._table])
        elif node.operation == "result":
            call = node.args[0]
            body = self.loop.bodies[id(call.place)]
            place = body.n_parameters + list(body.results).index(node.place)
            self._memory[id(node)] = self._slot(work, self._frame_at[id(call)] + place)
        elif node.operation != "read":
            self._emit(node)
        elif node.place[0] == "state":
            self._memory[id(node)] = self._slot(old, node.place[1])
        else:
            self.values[id(node)] = self._load(at_input[node.place[1]], node.is_varying)

    def _give(self, call: Node, work: Any, is_fixed: bool) -> None:
        """Write the parameters of a call that stay the same at every sample, or the others."""
        count = self.loop.bodies[id(call.place)].n_parameters
        for place, x in enumerate(call.args[:count], self._frame_at[id(call)]):
            stays = is_known(x) or (x is not None and self._is_fixed[id(x)])
            if x is not None and stays == is_fixed:
                self._keep(self._broadcast(x), self._slot(work, place))

    def _change(self, changes: Iterable[Change], new: Any) -> None:
        for change in changes:
            self._keep(self._broadcast(change.value), self._slot(new, change.slot))

    def _repair(self, old: Any, new: Any) -> None:
        """Put the old numbers back where a case does not change."""
        masked = [change for change in self.loop.changes if not is_known(change.mask)]
        if not masked:
            return
        every = None
        for mask in {id(change.mask): change.mask for change in masked}.values():
            one = self._broadcast(mask)
            every = one if every is None else self.builder.and_(every, one)
        if self.width > 1:
            name = f"llvm.vector.reduce.and.v{self.width}i1"
            every = self._call(name, ir.IntType(1), every)
        function = self.builder.function
        repair, leave = map(function.append_basic_block, ("repair", "leave"))
        self.builder.cbranch(every, leave, repair).set_weights([2000, 1])
        self.builder.position_at_end(repair)
        for change in masked:
            slot = self._slot(new, change.slot)
            kept = self._kept(self._slot(old, change.slot))
            mask = self._broadcast(change.mask)
            self._keep(self.builder.select(mask, self._kept(slot), kept), slot)
        self.builder.branch(leave)
        self.builder.position_at_end(leave)
