//! Executes the instructions of a pickle to build its object tree. The number of instructions, the nesting depth and
//! the memory are limited.

use std::ops::Range;

use hashbrown::HashMap;

use super::{MAX_DEPTH, Node, NodeId, Pickle, PickleError};

/// Maximum number of instructions in a pickle. One tensor takes about 35, so this is enough for 50,000 tensors.
const MAX_INSTRUCTIONS: u32 = 1 << 21;
/// Bytes of memory to count for each heap allocation in addition to its size: an upper bound of the allocator's
/// overhead.
const ALLOCATION_BYTES: usize = 32;
/// Bytes of memory per entry of the memo (table of nodes that the pickle refers to again), including the growth of the
/// table.
const MEMO_ENTRY_BYTES: usize = 32;

/// Counter of allocated bytes. Refuses an allocation that would exceed the memory limit before it is made.
#[derive(Debug)]
struct AllocationCounter {
    limit: u64,
    taken: u64,
}

impl AllocationCounter {
    /// Counts `bytes` bytes of memory that are about to be allocated. Fails if the memory limit would be exceeded; the
    /// error names the byte `at` of the pickle.
    fn take(&mut self, bytes: usize, at: usize) -> Result<(), PickleError> {
        let taken = self.taken.saturating_add(bytes as u64);
        if taken > self.limit {
            return Err(PickleError::Memory(at, taken));
        }
        self.taken = taken;
        Ok(())
    }

    /// Reserves memory for `more` elements of `list`. Fails if the memory limit would be exceeded; the error names the
    /// byte `at` of the pickle. While the list grows, the old and the new buffer exist together; both are counted.
    fn reserve<T>(&mut self, list: &mut Vec<T>, more: usize, at: usize) -> Result<(), PickleError> {
        let (needed, old) = (list.len() + more, list.capacity());
        if needed > old {
            let capacity = needed.max(2 * old).max(4);
            self.take(ALLOCATION_BYTES + capacity * size_of::<T>(), at)?;
            list.reserve_exact(capacity - list.len());
            if old > 0 {
                self.taken -= (ALLOCATION_BYTES + old * size_of::<T>()) as u64;
            }
        }
        Ok(())
    }
}

/// Virtual machine that executes a pickle and builds the nodes of its object tree.
pub(super) struct PickleMachine<'a> {
    bytes: &'a [u8],
    at: usize,
    instructions: u32,
    allocations: AllocationCounter,
    nodes: Vec<Node>,
    /// For each node, its nesting depth: 0 for a scalar, 1 for a container of scalars, and so on. The depth of a node
    /// is not updated when a container inside it grows later, so code that traverses the tree must count the depth
    /// itself.
    depths: Vec<u8>,
    frames: Vec<Range<usize>>,
    stack: Vec<NodeId>,
    marks: Vec<usize>,
    memo: HashMap<u32, NodeId>,
}

impl<'a> PickleMachine<'a> {
    /// Returns a machine that starts at the first instruction in `bytes` and may allocate `memory` bytes.
    pub(super) fn new(bytes: &'a [u8], memory: u64) -> PickleMachine<'a> {
        PickleMachine {
            bytes,
            at: 0,
            instructions: 0,
            allocations: AllocationCounter { limit: memory, taken: 0 },
            nodes: Vec::new(),
            depths: Vec::new(),
            frames: Vec::new(),
            stack: Vec::new(),
            marks: Vec::new(),
            memo: HashMap::new(),
        }
    }

    /// Executes all instructions and returns the object tree.
    ///
    /// # Errors
    /// Fails at the first instruction that is malformed or exceeds a limit.
    pub(super) fn read(mut self) -> Result<Pickle, PickleError> {
        loop {
            if let Some(root) = self.step()? {
                return Ok(Pickle { nodes: self.nodes, root, frames: self.frames });
            }
        }
    }

    /// Executes the next instruction. Returns the root node of the object tree after the last instruction, else `None`.
    fn step(&mut self) -> Result<Option<NodeId>, PickleError> {
        let start = self.at;
        self.count_instruction(start)?;
        let [instruction] = self.take_bytes()?;
        match instruction {
            // PROTO and FRAME build no value.
            0x80 => drop(self.take_bytes::<1>()?),
            0x95 => {
                self.take_bytes::<8>()?;
                self.allocations.reserve(&mut self.frames, 1, start)?;
                self.frames.push(start..self.at);
            }
            b'.' => return self.pop().map(Some),
            b'(' => self.mark(start)?,
            b'0' => drop(self.pop()?),
            b'1' | b't' | b'l' | 0x91 | b'd' | b'e' | 0x90 | b'u' => self.close(instruction, start)?,
            b'c' => self.global(start)?,
            0x93 => self.stack_global(start)?,
            b')' => self.push(Node::Tuple(Vec::new()), 1)?,
            b']' | 0x8f => self.push(Node::List(Vec::new()), 1)?,
            b'}' => self.push(Node::Dict(Vec::new()), 1)?,
            0x85..=0x87 => {
                let first = self.tuple_start(usize::from(instruction - 0x84), start)?;
                self.collect(first, Node::Tuple)?;
            }
            b'a' => {
                let first = self.beyond_top(1)?;
                self.extend(start, first)?;
            }
            b's' => {
                let first = self.beyond_top(2)?;
                self.set(start, first)?;
            }
            b'R' | 0x81 => {
                let (arguments, callee) = (self.pop()?, self.pop()?);
                let depth = self.container_depth([arguments, callee])?;
                self.push(Node::Called { callee, arguments, items: Vec::new() }, depth)?;
            }
            // BUILD sets attributes of an object. They are dropped, because only the items of an object are needed.
            b'b' => drop(self.pop()?),
            b'Q' => {
                let what = self.pop()?;
                let depth = self.container_depth([what])?;
                self.push(Node::PersistentId(what), depth)?;
            }
            b'q' | b'r' => {
                let key = self.unsigned(if instruction == b'q' { 1 } else { 4 })?;
                self.store_in_memo(key as u32)?;
            }
            0x94 => self.store_in_memo(self.memo.len() as u32)?,
            b'h' | b'j' => {
                let key = self.unsigned(if instruction == b'h' { 1 } else { 4 })?;
                self.push_from_memo(start, key as u32)?;
            }
            other => self.step_scalar(other, start)?,
        }
        Ok(None)
    }

    /// Executes the instruction `instruction`, which began at byte `start`. It uses all values since the last MARK: puts
    /// them into a new container, adds them to the container below them, or drops them.
    fn close(&mut self, instruction: u8, start: usize) -> Result<(), PickleError> {
        let first = self.unmark()?;
        match instruction {
            b't' => self.collect(first, Node::Tuple),
            b'l' | 0x91 => self.collect(first, Node::List),
            b'd' => {
                self.push_below(Node::Dict(Vec::new()), first)?;
                self.set(start, first + 1)
            }
            b'e' | 0x90 => self.extend(start, first),
            b'u' => self.set(start, first),
            // POP_MARK drops the values.
            _ => {
                self.stack.truncate(first);
                Ok(())
            }
        }
    }

    /// Returns the index on the stack of the first value of a tuple that takes the top `count` values. Fails if there are
    /// fewer values above the last mark. `start`: byte at which the instruction begins.
    fn tuple_start(&self, count: usize, start: usize) -> Result<usize, PickleError> {
        let first = self.stack.len().checked_sub(count).filter(|&first| first >= self.floor());
        first.ok_or(PickleError::at(start, "a tuple of more values than there are"))
    }

    /// Counts one instruction, which begins at byte `start`. Fails if there are more than [`MAX_INSTRUCTIONS`].
    fn count_instruction(&mut self, start: usize) -> Result<(), PickleError> {
        self.instructions += 1;
        if self.instructions > MAX_INSTRUCTIONS {
            return Err(PickleError::TooMuch(start, format!("at most {MAX_INSTRUCTIONS} instructions"), "more".into()));
        }
        Ok(())
    }

    /// Executes the instruction `instruction`, which was read at byte `start`, if it pushes a value that contains no
    /// other values: a number, a text, bytes, a boolean or `None`. Fails for all other instructions.
    fn step_scalar(&mut self, instruction: u8, start: usize) -> Result<(), PickleError> {
        match instruction {
            b'N' => self.push(Node::None, 0)?,
            0x88 => self.push(Node::Bool(true), 0)?,
            0x89 => self.push(Node::Bool(false), 0)?,
            b'K' | b'M' => {
                let value = self.unsigned(if instruction == b'K' { 1 } else { 2 })?;
                self.push_int(value as i64, start)?;
            }
            b'J' => {
                let value = i32::from_le_bytes(self.take_bytes()?);
                self.push_int(value.into(), start)?;
            }
            0x8a => self.long(1, start)?,
            0x8b => self.long(4, start)?,
            b'G' => {
                let value = f64::from_be_bytes(self.take_bytes()?);
                self.push(Node::Float(value), 0)?;
            }
            b'X' => self.text(4)?,
            0x8c => self.text(1)?,
            0x8d => self.text(8)?,
            b'B' | b'T' => self.blob(4)?,
            b'C' | b'U' => self.blob(1)?,
            0x8e | 0x96 => self.blob(8)?,
            other => return Err(PickleError::at(start, format!("instruction {other:#04x}"))),
        }
        Ok(())
    }

    /// Adds `node` to the object tree and pushes its index onto the stack. `depth` is the nesting depth of the node, 0
    /// for a scalar.
    fn push(&mut self, node: Node, depth: u8) -> Result<(), PickleError> {
        self.allocations.reserve(&mut self.nodes, 1, self.at)?;
        self.allocations.reserve(&mut self.depths, 1, self.at)?;
        self.allocations.reserve(&mut self.stack, 1, self.at)?;
        self.stack.push(self.nodes.len() as NodeId);
        self.nodes.push(node);
        self.depths.push(depth);
        Ok(())
    }

    /// Adds `node`, an empty container, to the object tree and inserts its index into the stack at index `place`, below
    /// the values that will be added to the container.
    fn push_below(&mut self, node: Node, place: usize) -> Result<(), PickleError> {
        self.push(node, 1)?;
        self.stack[place..].rotate_right(1);
        Ok(())
    }

    /// Pushes the integer `value` onto the stack, with the byte range of its instruction, which began at byte `start`.
    fn push_int(&mut self, value: i64, start: usize) -> Result<(), PickleError> {
        self.push(Node::Int(value, start as u32..self.at as u32), 0)
    }

    /// Returns the nesting depth of a new container whose elements are `nodes`: one more than the largest depth among
    /// them. Fails if it would exceed [`MAX_DEPTH`].
    fn container_depth(&self, nodes: impl IntoIterator<Item = NodeId>) -> Result<u8, PickleError> {
        let deepest = nodes.into_iter().map(|id| self.depths[id as usize]).max().unwrap_or(0);
        match deepest < MAX_DEPTH {
            true => Ok(deepest + 1),
            false => Err(self.too_deep()),
        }
    }

    /// Returns the error for containers that are nested too deep.
    fn too_deep(&self) -> PickleError {
        PickleError::TooMuch(self.at, format!("containers nested at most {MAX_DEPTH} deep"), "deeper ones".into())
    }

    /// Executes the instruction MARK, which began at byte `start`: it opens a container whose elements are pushed next.
    /// Records the present height of the stack as the index of the first element. Fails if too many containers are
    /// open.
    fn mark(&mut self, start: usize) -> Result<(), PickleError> {
        if self.marks.len() >= usize::from(MAX_DEPTH) {
            return Err(self.too_deep());
        }
        self.allocations.reserve(&mut self.marks, 1, start)?;
        self.marks.push(self.stack.len());
        Ok(())
    }

    /// Returns the lowest stack index that instructions may use at present: the index of the first element of the
    /// innermost open container; 0 if no container is open.
    fn floor(&self) -> usize {
        self.marks.last().copied().unwrap_or(0)
    }

    /// Returns the error for an instruction that needs more values than there are on the stack since the last MARK
    /// (instruction that opens a container).
    fn missing(&self) -> PickleError {
        PickleError::at(self.at, "a value that was never given")
    }

    /// Removes the top value of the stack and returns its node. Fails if no value was pushed since the innermost open
    /// container was begun.
    fn pop(&mut self) -> Result<NodeId, PickleError> {
        match self.stack.len() > self.floor() {
            true => Ok(self.stack.pop().expect("there is one")),
            false => Err(self.missing()),
        }
    }

    /// Returns the stack index of the lowest of the `count` values on top of the stack. Used by instructions that add
    /// these values to a list or dict, which must lie directly below them on the stack. Fails if fewer than `count` + 1
    /// values were pushed since the innermost open container was begun.
    fn beyond_top(&self, count: usize) -> Result<usize, PickleError> {
        self.stack.len().checked_sub(count).filter(|&first| first > self.floor()).ok_or_else(|| self.missing())
    }

    /// Closes the innermost open container (the last MARK instruction). Returns the stack index of its first element.
    fn unmark(&mut self) -> Result<usize, PickleError> {
        let mark = self.marks.pop().ok_or(PickleError::at(self.at, "the end of a container that was never begun"))?;
        Ok(mark.min(self.stack.len()))
    }

    /// Removes the values from stack index `first` up to the top, and pushes one container with these values as
    /// elements. `make` builds the node of the container from the nodes of the elements.
    fn collect(&mut self, first: usize, make: fn(Vec<NodeId>) -> Node) -> Result<(), PickleError> {
        let depth = self.container_depth(self.stack[first..].iter().copied())?;
        let mut elements = Vec::new();
        if first < self.stack.len() {
            let count = self.stack.len() - first;
            self.allocations.take(ALLOCATION_BYTES + count * size_of::<NodeId>(), self.at)?;
            elements.reserve_exact(count);
            elements.extend(self.stack.drain(first..));
        }
        self.push(make(elements), depth)
    }

    /// Returns the node index of the container to which an instruction adds values. The values are those from stack
    /// index `first` up to the top, and the container is directly below them on the stack. Sets the nesting depth of
    /// the container to at least one more than the depths of the values. Fails if there is nothing below the values in
    /// the innermost open container, or if the nesting would be too deep.
    fn container(&mut self, first: usize) -> Result<usize, PickleError> {
        let below = first.checked_sub(1).filter(|&below| below >= self.floor());
        let top = self.stack[below.ok_or_else(|| self.missing())?] as usize;
        let depth = self.container_depth(self.stack[first..].iter().copied())?;
        self.depths[top] = self.depths[top].max(depth);
        Ok(top)
    }

    /// Appends the values from stack index `first` up to the top to the list directly below them on the stack, and
    /// removes them from the stack. If there is the result of a call below them (an object with a method `append`), the
    /// values are discarded, because they are not needed. Fails for anything else; the error names byte `start` of the
    /// pickle.
    fn extend(&mut self, start: usize, first: usize) -> Result<(), PickleError> {
        let top = self.container(first)?;
        match &mut self.nodes[top] {
            Node::List(list) => {
                self.allocations.reserve(list, self.stack.len() - first, start)?;
                list.extend(self.stack.drain(first..));
            }
            // Drop the elements of an object that behaves like a list, because they are not needed.
            Node::Called { .. } => self.stack.truncate(first),
            _ => return Err(PickleError::at(start, "an element added to a value that is not a list")),
        }
        Ok(())
    }

    /// Adds keys and values to the dict, or the result of a call (such as an `OrderedDict`), that lies directly below
    /// them on the stack. Keys and values alternate from stack index `first` up to the top; they are removed from the
    /// stack. Fails if anything else lies below them, or if a key has no value; the error names byte `start` of the
    /// pickle.
    fn set(&mut self, start: usize, first: usize) -> Result<(), PickleError> {
        let top = self.container(first)?;
        let (pairs, rest) = self.stack[first..].as_chunks::<2>();
        if !rest.is_empty() {
            return Err(PickleError::at(start, "a key without a value"));
        }
        match &mut self.nodes[top] {
            Node::Dict(items) | Node::Called { items, .. } => {
                self.allocations.reserve(items, pairs.len(), start)?;
                items.extend(pairs.iter().map(|&[key, value]| (key, value)));
            }
            _ => return Err(PickleError::at(start, "an item added to a value that is not a dict")),
        }
        self.stack.truncate(first);
        Ok(())
    }

    /// Stores the top value of the stack in the memo (table of nodes for later reference) under `key`.
    fn store_in_memo(&mut self, key: u32) -> Result<(), PickleError> {
        let top = self.stack.last().copied().filter(|_| self.stack.len() > self.floor());
        let top = top.ok_or_else(|| self.missing())?;
        self.allocations.take(MEMO_ENTRY_BYTES, self.at)?;
        self.memo.insert(key, top);
        Ok(())
    }

    /// Pushes the node that is stored in the memo (table of nodes for later reference) under `key`. Fails if there is
    /// none; the error names byte `start` of the pickle.
    fn push_from_memo(&mut self, start: usize, key: u32) -> Result<(), PickleError> {
        let known = self.memo.get(&key).copied();
        let known = known.ok_or_else(|| PickleError::at(start, format!("memo entry {key}, which was never stored")))?;
        self.allocations.reserve(&mut self.stack, 1, start)?;
        self.stack.push(known);
        Ok(())
    }

    /// Reads the next `N` bytes of the pickle.
    fn take_bytes<const N: usize>(&mut self) -> Result<[u8; N], PickleError> {
        let taken = self.take_slice(N as u64)?;
        Ok(taken.try_into().expect("as many"))
    }

    /// Reads the next `count` bytes of the pickle.
    fn take_slice(&mut self, count: u64) -> Result<&[u8], PickleError> {
        let left = self.bytes.len() - self.at;
        let count = usize::try_from(count).ok().filter(|&count| count <= left);
        let count = count.ok_or(PickleError::at(self.at, "the end of the pickle"))?;
        self.at += count;
        Ok(&self.bytes[self.at - count..self.at])
    }

    /// Reads an integer of any length and pushes it onto the stack. `start` is the byte at which its instruction began.
    /// The pickle holds the number of bytes of the integer first, which takes `length_bytes` bytes, then the integer.
    /// An integer that does not fit into `i64` becomes [`Node::Opaque`].
    fn long(&mut self, length_bytes: usize, start: usize) -> Result<(), PickleError> {
        let length = self.unsigned(length_bytes)?;
        let digits = self.take_slice(length)?;
        // Ignore a ninth byte of 0, which only keeps the highest bit of the eighth byte from being taken for a sign.
        let digits = match digits {
            [eight @ .., 0] if eight.len() == 8 && eight[7] < 0x80 => eight,
            digits => digits,
        };
        if digits.len() > 8 {
            return self.push(Node::Opaque, 0);
        }
        let negative = digits.last().is_some_and(|last| last & 0x80 != 0);
        let mut wide = [if negative { 0xff } else { 0 }; 8];
        wide[..digits.len()].copy_from_slice(digits);
        self.push_int(i64::from_le_bytes(wide), start)
    }

    /// Reads a non-negative integer that is stored in `bytes` bytes, such as a length.
    fn unsigned(&mut self, bytes: usize) -> Result<u64, PickleError> {
        let mut wide = [0; 8];
        wide[..bytes].copy_from_slice(self.take_slice(bytes as u64)?);
        Ok(u64::from_le_bytes(wide))
    }

    /// Reads a UTF-8 text and pushes it onto the stack. The pickle holds the length of the text in bytes first, which
    /// takes `length_bytes` bytes, then the text.
    fn text(&mut self, length_bytes: usize) -> Result<(), PickleError> {
        let length = self.unsigned(length_bytes)?;
        let start = self.at;
        self.take_slice(length)?;
        self.allocations.take(ALLOCATION_BYTES + (self.at - start), start)?;
        let text = std::str::from_utf8(&self.bytes[start..self.at]);
        let text = text.map_err(|_| PickleError::at(start, "a text that is not UTF-8"))?;
        self.push(Node::Text(text.into()), 0)
    }

    /// Skips a byte string and pushes [`Node::Opaque`] for it. The pickle holds the length of the byte string first,
    /// which takes `length_bytes` bytes, then the bytes.
    fn blob(&mut self, length_bytes: usize) -> Result<(), PickleError> {
        let length = self.unsigned(length_bytes)?;
        self.take_slice(length)?;
        self.push(Node::Opaque, 0)
    }

    /// Executes the instruction GLOBAL, which began at byte `start`: reads the module and the name of a function or
    /// class as two lines and pushes a node for this function or class.
    fn global(&mut self, start: usize) -> Result<(), PickleError> {
        let (module, name) = (self.line()?, self.line()?);
        self.allocations.take(ALLOCATION_BYTES + module.len() + 1 + name.len(), start)?;
        let text = |line: Range<usize>| {
            std::str::from_utf8(&self.bytes[line.clone()])
                .map_err(|_| PickleError::at(line.start, "a name that is not UTF-8"))
        };
        let global = [text(module)?, ".", text(name)?].concat();
        self.push(Node::Global(global.into()), 0)
    }

    /// Executes the instruction STACK_GLOBAL, which began at byte `start`: replaces two texts on the stack, a module
    /// and a name, by a node for the function or class with this name. A long text may be used many times, so each copy
    /// of it is counted as memory.
    fn stack_global(&mut self, start: usize) -> Result<(), PickleError> {
        let (name, module) = (self.pop()?, self.pop()?);
        let (Node::Text(module), Node::Text(name)) = (&self.nodes[module as usize], &self.nodes[name as usize]) else {
            return Err(PickleError::at(start, "a global without the texts of its module and name"));
        };
        self.allocations.take(ALLOCATION_BYTES + module.len() + 1 + name.len(), start)?;
        let global = [module, ".", name].concat();
        self.push(Node::Global(global.into()), 0)
    }

    /// Reads a line. Returns its byte range without the line end.
    fn line(&mut self) -> Result<Range<usize>, PickleError> {
        let start = self.at;
        let end = self.bytes[start..].iter().position(|&byte| byte == b'\n');
        self.take_slice(end.map_or(u64::MAX, |end| end as u64 + 1))?;
        Ok(start..self.at - 1)
    }
}
