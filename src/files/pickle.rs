//! Pickles as data: what a pickle builds, and where in its bytes every number stands, so that some of them can be written
//! anew and all else stays as it was. Nothing is ever executed: what a pickle would call is a name here.
//!
//! Input: the bytes of a pickle of protocol 2 to 5, as `torch.save` writes them. Output: nodes that refer to each other by
//! number. A shared value is one node, and nothing here recurses, so cycles are harmless. Source: CPython's `pickletools`.
//!
//! Memory: every allocation is counted before it is made (`read.rs`). The number of instructions, the nesting depth and the
//! counted bytes are limited, whatever the pickle says of itself.

use std::collections::BTreeMap;
use std::ops::Range;

use crate::error::quoted;

mod read;
#[cfg(test)]
mod tests;

use read::PickleMachine;

/// Maximum nesting depth of containers. Checkpoints of trained models reach about 10.
pub(crate) const MAX_DEPTH: u8 = 100;
/// Maximum memory in bytes, whatever the caller allows. Ten thousand tensors take about 30 MB.
const MAX_MEMORY: u64 = 128 << 20;

/// A place in [`Pickle`].
pub(crate) type NodeId = u32;

/// A value of a pickle.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Node {
    /// `None`.
    None,
    /// `True`, `False`.
    Bool(bool),
    /// A whole number, and its bytes in the pickle.
    Int(i64, Range<u32>),
    /// A number.
    Float(f64),
    /// A text.
    Text(Box<str>),
    /// Bytes, or a number of more than eight; nobody asks which.
    Opaque,
    /// Something of a module.
    Global(Box<str>),
    /// A tuple.
    Tuple(Vec<NodeId>),
    /// A list or a set.
    List(Vec<NodeId>),
    /// A dict: keys and values, in order.
    Dict(Vec<(NodeId, NodeId)>),
    /// What calling `callee` with `arguments` would give, and the items that are then set in it.
    Called { callee: NodeId, arguments: NodeId, items: Vec<(NodeId, NodeId)> },
    /// Something that lies outside, by what names it.
    Outside(NodeId),
}

/// A pickle that was read.
#[derive(Debug)]
pub(crate) struct Pickle {
    nodes: Vec<Node>,
    root: NodeId,
    /// Where instructions say how many bytes follow.
    frames: Vec<Range<usize>>,
}

/// Why a pickle cannot be read.
#[derive(Debug, PartialEq)]
pub(crate) enum Wrong {
    /// Malformed or not supported: the byte, and what was found there.
    Malformed(usize, String),
    /// Beyond a fixed limit: the byte, what was expected, and what was found.
    TooMuch(usize, String, String),
    /// Reading takes more than the allowed memory: the byte, and how many bytes it takes up to there.
    Memory(usize, u64),
}

impl Wrong {
    /// Malformed at byte `at`.
    fn at(at: usize, found: impl Into<String>) -> Wrong {
        Wrong::Malformed(at, found.into())
    }
}

impl Pickle {
    /// Reads `bytes` within `memory` bytes of memory, beside `bytes` themselves.
    ///
    /// # Errors
    /// Bytes that end too early, use values that do not exist, or contain an instruction that no tensors need; more
    /// instructions, depth or memory than the limits.
    pub(crate) fn read(bytes: &[u8], memory: u64) -> Result<Pickle, Wrong> {
        if u32::try_from(bytes.len()).is_err() {
            return Err(Wrong::TooMuch(0, "a pickle below 4 GiB".into(), format!("{} bytes", bytes.len())));
        }
        PickleMachine::new(bytes, memory.min(MAX_MEMORY)).read()
    }

    /// The whole.
    pub(crate) fn root(&self) -> NodeId {
        self.root
    }

    /// The node at a place.
    pub(crate) fn node(&self, id: NodeId) -> &Node {
        &self.nodes[id as usize]
    }

    /// Every node, by number.
    pub(crate) fn ids(&self) -> std::ops::Range<NodeId> {
        0..self.nodes.len() as NodeId
    }

    /// Keys and values, in order, of a dict or of an ordered one.
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

    /// Keys that are texts, and their values, of a dict or of an ordered one.
    pub(crate) fn items(&self, id: NodeId) -> Option<impl Iterator<Item = (&str, NodeId)>> {
        let named = |&(key, value): &(NodeId, NodeId)| Some((self.text(key)?, value));
        Some(self.pairs(id)?.iter().filter_map(named))
    }

    /// What a dict has under a text; the last one, as in Python, if it was set more than once.
    pub(crate) fn item(&self, id: NodeId, key: &str) -> Option<NodeId> {
        self.items(id)?.filter(|(name, _)| *name == key).last().map(|(_, value)| value)
    }

    /// The elements of a tuple or a list.
    pub(crate) fn elements(&self, id: NodeId) -> Option<&[NodeId]> {
        match self.node(id) {
            Node::Tuple(elements) | Node::List(elements) => Some(elements),
            _ => None,
        }
    }

    /// A text.
    pub(crate) fn text(&self, id: NodeId) -> Option<&str> {
        match self.node(id) {
            Node::Text(text) => Some(text),
            _ => None,
        }
    }

    /// A whole number.
    pub(crate) fn int(&self, id: NodeId) -> Option<i64> {
        match self.node(id) {
            Node::Int(value, _) => Some(*value),
            _ => None,
        }
    }

    /// Name and arguments of what would be called.
    pub(crate) fn call(&self, id: NodeId) -> Option<(&str, &[NodeId])> {
        let Node::Called { callee, arguments, .. } = self.node(id) else { return None };
        match self.node(*callee) {
            Node::Global(name) => Some((name, self.elements(*arguments)?)),
            _ => None,
        }
    }

    /// What a node is, for a person.
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
            Node::Outside(_) => "a storage".into(),
        }
    }

    /// `bytes`, those that this was read from, with other whole numbers in the places that `numbers` names. What says how
    /// many bytes follow is left out: no reader needs it.
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

/// The instruction that gives `value`.
fn int(value: u64) -> Vec<u8> {
    match value {
        0..=0xff => vec![b'K', value as u8],
        0x100..=0xffff => [&[b'M'][..], &(value as u16).to_le_bytes()].concat(),
        0x1_0000..=0x7fff_ffff => [&[b'J'][..], &(value as u32).to_le_bytes()].concat(),
        // Nine bytes, of which the last has no sign.
        _ => [&[0x8a, 9][..], &value.to_le_bytes(), &[0]].concat(),
    }
}
