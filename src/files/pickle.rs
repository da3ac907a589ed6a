//! Reads pickles (serialized Python objects) as data: the object tree that a pickle builds, and the byte range of every
//! integer in it, so that some integers can be replaced while all other bytes stay unchanged. Nothing is executed:
//! functions and classes that a pickle would call appear only as names in the tree.
//!
//! Input: the bytes of a pickle of protocol 2 to 5, as written by `torch.save`. Output: the nodes of the object tree,
//! which refer to each other by index. A value that is used several times is one node. This module does not recurse, so
//! cycles are harmless. Source: CPython's `pickletools`.
//!
//! Memory: every allocation is counted before it is made (`read.rs`). The number of instructions, the nesting depth and
//! the counted bytes are limited, whatever the pickle declares.

use std::collections::BTreeMap;
use std::ops::Range;

use crate::error::quoted;

mod read;
#[cfg(test)]
mod tests;

use read::PickleMachine;

/// Maximum nesting depth of containers (lists, tuples, dicts). Checkpoints of trained models reach about 10.
pub(crate) const MAX_DEPTH: u8 = 100;
/// Maximum memory in bytes for reading a pickle, even if the caller allows more. A pickle that describes ten thousand
/// tensors takes about 30 MB.
const MAX_MEMORY: u64 = 128 << 20;

/// Index of a node in the object tree of a [`Pickle`].
pub(crate) type NodeId = u32;

/// Node of the object tree of a pickle: one Python value.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Node {
    /// The Python value `None`.
    None,
    /// A boolean.
    Bool(bool),
    /// An integer, and its byte range in the pickle.
    Int(i64, Range<u32>),
    /// A floating-point number.
    Float(f64),
    /// A string.
    Text(Box<str>),
    /// Bytes, or an integer of more than eight bytes. The value is not kept, because no reader needs it.
    Opaque,
    /// A function or class of a module, by its full name.
    Global(Box<str>),
    /// Elements of a tuple.
    Tuple(Vec<NodeId>),
    /// Elements of a list or a set.
    List(Vec<NodeId>),
    /// Keys and values of a dict, in order.
    Dict(Vec<(NodeId, NodeId)>),
    /// Result of calling `callee` with `arguments`, and the items that are set in the result afterwards.
    Called { callee: NodeId, arguments: NodeId, items: Vec<(NodeId, NodeId)> },
    /// Reference to an object that is stored outside the pickle (persistent id), such as the values of a tensor. The
    /// field is the node of the value that identifies the object.
    PersistentId(NodeId),
}

/// Object tree that a pickle describes: one node per Python value.
#[derive(Debug)]
pub(crate) struct Pickle {
    nodes: Vec<Node>,
    root: NodeId,
    /// Byte ranges of the FRAME instructions in the pickle. Such an instruction only announces how many bytes of
    /// further instructions follow.
    frames: Vec<Range<usize>>,
}

/// Reason why a pickle cannot be read.
#[derive(Debug, PartialEq)]
pub(crate) enum PickleError {
    /// The pickle is malformed or contains an unsupported instruction: byte offset and description.
    Malformed(usize, String),
    /// The pickle exceeds a fixed limit: byte offset, the limit, and a description of what was found.
    TooMuch(usize, String, String),
    /// The pickle needs more memory than allowed: byte offset, and the bytes of memory needed up to there.
    Memory(usize, u64),
}

impl PickleError {
    /// Builds the error for a pickle with malformed content at byte `at`. `found` describes the content for the
    /// message.
    fn at(at: usize, found: impl Into<String>) -> PickleError {
        PickleError::Malformed(at, found.into())
    }
}

impl Pickle {
    /// Reads the pickle in `bytes` with at most `memory` bytes of memory, not counting `bytes` themselves.
    ///
    /// # Errors
    /// Fails if the bytes end too early, refer to values that do not exist, or contain an instruction that no tensor
    /// needs, or if the number of instructions, the nesting depth or the memory exceeds its limit.
    pub(crate) fn read(bytes: &[u8], memory: u64) -> Result<Pickle, PickleError> {
        if u32::try_from(bytes.len()).is_err() {
            return Err(PickleError::TooMuch(0, "a pickle below 4 GiB".into(), format!("{} bytes", bytes.len())));
        }
        PickleMachine::new(bytes, memory.min(MAX_MEMORY)).read()
    }

    /// Returns the root node, which stands for the whole value of the pickle.
    pub(crate) fn root(&self) -> NodeId {
        self.root
    }

    /// Returns the node with index `id`.
    pub(crate) fn node(&self, id: NodeId) -> &Node {
        &self.nodes[id as usize]
    }

    /// Returns the indices of all nodes.
    pub(crate) fn ids(&self) -> std::ops::Range<NodeId> {
        0..self.nodes.len() as NodeId
    }

    /// Returns the (key, value) pairs of node `id` in order if it is a dict or an `OrderedDict`; `None` for other
    /// nodes.
    pub(crate) fn pairs(&self, id: NodeId) -> Option<&[(NodeId, NodeId)]> {
        match self.node(id) {
            Node::Dict(items) => Some(items),
            Node::Called { callee, items, .. } => match self.node(*callee) {
                Node::Global(name) if &**name == "collections.OrderedDict" => Some(items),
                _ => None,
            },
            _ => None,
        }
    }

    /// Returns the (key, value) pairs of node `id` if it is a dict or an `OrderedDict`; `None` for other nodes. Leaves
    /// out pairs whose keys are not strings.
    pub(crate) fn items(&self, id: NodeId) -> Option<impl Iterator<Item = (&str, NodeId)>> {
        let named = |&(key, value): &(NodeId, NodeId)| Some((self.text(key)?, value));
        Some(self.pairs(id)?.iter().filter_map(named))
    }

    /// Returns the value of the dict `id` under the string `key`; `None` if node `id` is not a dict or has no such key.
    /// If the key was set more than once, the last value counts, as in Python.
    pub(crate) fn item(&self, id: NodeId, key: &str) -> Option<NodeId> {
        self.items(id)?.filter(|(name, _)| *name == key).last().map(|(_, value)| value)
    }

    /// Returns the elements of node `id` if it is a tuple or a list; `None` for other nodes.
    pub(crate) fn elements(&self, id: NodeId) -> Option<&[NodeId]> {
        match self.node(id) {
            Node::Tuple(elements) | Node::List(elements) => Some(elements),
            _ => None,
        }
    }

    /// Returns the text of node `id` if it is a string; `None` for other nodes.
    pub(crate) fn text(&self, id: NodeId) -> Option<&str> {
        match self.node(id) {
            Node::Text(text) => Some(text),
            _ => None,
        }
    }

    /// Returns the value of node `id` if it is an integer; `None` for other nodes.
    pub(crate) fn int(&self, id: NodeId) -> Option<i64> {
        match self.node(id) {
            Node::Int(value, _) => Some(*value),
            _ => None,
        }
    }

    /// Returns the name of the called function and the arguments if node `id` is the result of a call; `None` for other
    /// nodes.
    pub(crate) fn call(&self, id: NodeId) -> Option<(&str, &[NodeId])> {
        let Node::Called { callee, arguments, .. } = self.node(id) else { return None };
        match self.node(*callee) {
            Node::Global(name) => Some((name, self.elements(*arguments)?)),
            _ => None,
        }
    }

    /// Returns a description of node `id` for messages.
    pub(crate) fn describe(&self, id: NodeId) -> String {
        const MOST: usize = 12;
        match self.node(id) {
            Node::None => "None".into(),
            Node::Bool(true) => "True".into(),
            Node::Bool(false) => "False".into(),
            Node::Int(value, _) => value.to_string(),
            Node::Float(value) => value.to_string(),
            Node::Text(text) => format!("the text {}", quoted(&text.chars().take(40).collect::<String>())),
            Node::Opaque => "bytes".into(),
            Node::Global(name) => name.to_string(),
            Node::Tuple(elements) => format!("a tuple of {}", elements.len()),
            Node::List(elements) => format!("a list of {}", elements.len()),
            Node::Called { .. } if self.pairs(id).is_none() => match self.call(id) {
                Some((name, _)) => format!("what {name} makes"),
                None => "an object".into(),
            },
            Node::Dict(_) | Node::Called { .. } => {
                let names: Vec<&str> = self.items(id).into_iter().flatten().map(|(name, _)| name).take(MOST).collect();
                format!("a dict of {}: {}", self.pairs(id).map_or(0, <[_]>::len), names.join(", "))
            }
            Node::PersistentId(_) => "a storage".into(),
        }
    }

    /// Returns the bytes of a copy of this pickle in which some integers have new values. `bytes` are the bytes from
    /// which the pickle was read. `numbers` maps the byte range (start, end) of an integer instruction to the new
    /// value. FRAME instructions, which only announce lengths that may now be wrong, are left out.
    pub(crate) fn with_numbers(&self, bytes: &[u8], numbers: &BTreeMap<(usize, usize), u64>) -> Vec<u8> {
        let mut edits: Vec<(Range<usize>, Vec<u8>)> =
            numbers.iter().map(|(&(start, end), &number)| (start..end, int(number))).collect();
        edits.extend(self.frames.iter().map(|frame| (frame.clone(), Vec::new())));
        edits.sort_by_key(|(at, _)| at.start);
        let (mut out, mut from) = (Vec::with_capacity(bytes.len()), 0);
        for (at, instead) in edits {
            out.extend(&bytes[from..at.start]);
            out.extend(instead);
            from = at.end;
        }
        out.extend(&bytes[from..]);
        out
    }
}

/// Encodes the pickle instruction that pushes the integer `value`, in the shortest form.
pub(crate) fn int(value: u64) -> Vec<u8> {
    match value {
        0..=0xff => vec![b'K', value as u8],
        0x100..=0xffff => [&[b'M'][..], &(value as u16).to_le_bytes()].concat(),
        0x1_0000..=0x7fff_ffff => [&[b'J'][..], &(value as u32).to_le_bytes()].concat(),
        // Encode as a long integer of nine bytes; the last byte is 0, so that the number is not negative.
        _ => [&[0x8a, 9][..], &value.to_le_bytes(), &[0]].concat(),
    }
}
