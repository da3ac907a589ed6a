//! Pickles as data: what a pickle builds, and where in its bytes every number stands, so that some of them can be written
//! anew and all else stays as it was. Nothing is ever executed: what a pickle would call is a name here.
//!
//! In: the bytes of a pickle of protocol 2 to 5, as `torch.save` writes them. Out: nodes that name each other by number, so
//! that what is shared is there once, and a circle is no danger to who follows a path of known length. Memory: a node of 56
//! bytes for every byte of the pickle at most, and what its vectors hold. Source: CPython's `pickletools`.

use std::collections::BTreeMap;
use std::ops::Range;

use hashbrown::HashMap;

use crate::error::quoted;

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
    Int(i64, Range<usize>),
    /// A number.
    Float(f64),
    /// A text.
    Text(String),
    /// Bytes, or a number of more than eight; nobody asks which.
    Opaque,
    /// Something of a module.
    Global(String),
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

/// Why bytes are no pickle that is read: where, and what was found there.
pub(crate) type Wrong = (usize, String);

impl Pickle {
    /// Reads `bytes`.
    ///
    /// # Errors
    /// Bytes that end too early, take what is not there, or are of an instruction that no tensors need.
    pub(crate) fn read(bytes: &[u8]) -> Result<Pickle, Wrong> {
        let mut reader = Reader {
            bytes,
            at: 0,
            nodes: Vec::new(),
            frames: Vec::new(),
            stack: Vec::new(),
            marks: Vec::new(),
            memo: HashMap::new(),
        };
        loop {
            if let Some(root) = reader.step()? {
                return Ok(Pickle { nodes: reader.nodes, root, frames: reader.frames });
            }
        }
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
                Node::Global(name) if name == "collections.OrderedDict" => Some(items),
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
            Node::Global(name) => name.clone(),
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

struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
    nodes: Vec<Node>,
    frames: Vec<Range<usize>>,
    stack: Vec<NodeId>,
    marks: Vec<usize>,
    memo: HashMap<usize, NodeId>,
}

impl Reader<'_> {
    /// Does one instruction; gives the root if it was the last.
    fn step(&mut self) -> Result<Option<NodeId>, Wrong> {
        let start = self.at;
        let [instruction] = self.take()?;
        match instruction {
            // PROTO, FRAME: nothing to do.
            0x80 => drop(self.take::<1>()?),
            0x95 => {
                self.take::<8>()?;
                self.frames.push(start..self.at);
            }
            b'.' => return self.pop().map(Some),
            b'(' => self.marks.push(self.stack.len()),
            b'0' => drop(self.pop()?),
            b'1' => drop(self.since_mark()?),
            b'N' => self.push(Node::None),
            0x88 => self.push(Node::Bool(true)),
            0x89 => self.push(Node::Bool(false)),
            b'K' => {
                let [value] = self.take()?;
                self.push_int(value.into(), start);
            }
            b'M' => {
                let value = u16::from_le_bytes(self.take()?);
                self.push_int(value.into(), start);
            }
            b'J' => {
                let value = i32::from_le_bytes(self.take()?);
                self.push_int(value.into(), start);
            }
            0x8a => self.long(1, start)?,
            0x8b => self.long(4, start)?,
            b'G' => {
                let value = f64::from_be_bytes(self.take()?);
                self.push(Node::Float(value));
            }
            b'X' => self.text(4)?,
            0x8c => self.text(1)?,
            0x8d => self.text(8)?,
            b'B' | b'T' => self.blob(4)?,
            b'C' | b'U' => self.blob(1)?,
            0x8e | 0x96 => self.blob(8)?,
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                self.push(Node::Global(format!("{module}.{name}")));
            }
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let (Node::Text(module), Node::Text(name)) = (&self.nodes[module as usize], &self.nodes[name as usize])
                else {
                    return Err((start, "something of a module without its name".into()));
                };
                let global = format!("{module}.{name}");
                self.push(Node::Global(global));
            }
            b')' => self.push(Node::Tuple(Vec::new())),
            b']' | 0x8f => self.push(Node::List(Vec::new())),
            b'}' => self.push(Node::Dict(Vec::new())),
            b't' => {
                let elements = self.since_mark()?;
                self.push(Node::Tuple(elements));
            }
            0x85..=0x87 => {
                let first = self
                    .stack
                    .len()
                    .checked_sub(usize::from(instruction - 0x84))
                    .filter(|&first| first >= self.floor());
                let first = first.ok_or((start, "a tuple of more than there is".to_owned()))?;
                let elements = self.stack.split_off(first);
                self.push(Node::Tuple(elements));
            }
            b'l' | 0x91 => {
                let elements = self.since_mark()?;
                self.push(Node::List(elements));
            }
            b'd' => {
                let elements = self.since_mark()?;
                let items = pairs(&elements).ok_or((start, "a key without a value".to_owned()))?;
                self.push(Node::Dict(items));
            }
            b'a' => {
                let element = self.pop()?;
                self.extend(start, &[element])?;
            }
            b'e' | 0x90 => {
                let elements = self.since_mark()?;
                self.extend(start, &elements)?;
            }
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.set(start, &[key, value])?;
            }
            b'u' => {
                let elements = self.since_mark()?;
                self.set(start, &elements)?;
            }
            b'R' | 0x81 => {
                let (arguments, callee) = (self.pop()?, self.pop()?);
                self.push(Node::Called { callee, arguments, items: Vec::new() });
            }
            // BUILD: what an object keeps beside its items is nobody's matter.
            b'b' => drop(self.pop()?),
            b'Q' => {
                let what = self.pop()?;
                self.push(Node::Outside(what));
            }
            b'q' => {
                let [key] = self.take()?;
                self.remember(key.into())?;
            }
            b'r' => {
                let key = u32::from_le_bytes(self.take()?);
                self.remember(key as usize)?;
            }
            0x94 => self.remember(self.memo.len())?,
            b'h' => {
                let [key] = self.take()?;
                self.recall(start, key.into())?;
            }
            b'j' => {
                let key = u32::from_le_bytes(self.take()?);
                self.recall(start, key as usize)?;
            }
            other => return Err((start, format!("instruction {other:#04x}"))),
        }
        Ok(None)
    }

    fn push(&mut self, node: Node) {
        self.stack.push(self.nodes.len() as NodeId);
        self.nodes.push(node);
    }

    fn push_int(&mut self, value: i64, start: usize) {
        self.push(Node::Int(value, start..self.at));
    }

    /// Below it the stack belongs to what was begun earlier.
    fn floor(&self) -> usize {
        self.marks.last().copied().unwrap_or(0)
    }

    fn pop(&mut self) -> Result<NodeId, Wrong> {
        match self.stack.len() > self.floor() {
            true => Ok(self.stack.pop().expect("there is one")),
            false => Err((self.at, "a value that was never given".into())),
        }
    }

    fn top(&self) -> Result<NodeId, Wrong> {
        self.stack[self.floor().min(self.stack.len())..]
            .last()
            .copied()
            .ok_or((self.at, "a value that was never given".into()))
    }

    fn since_mark(&mut self) -> Result<Vec<NodeId>, Wrong> {
        let mark = self.marks.pop().ok_or((self.at, "the end of what was never begun".to_owned()))?;
        Ok(self.stack.split_off(mark.min(self.stack.len())))
    }

    fn extend(&mut self, start: usize, elements: &[NodeId]) -> Result<(), Wrong> {
        let top = self.top()?;
        match &mut self.nodes[top as usize] {
            Node::List(list) => list.extend(elements),
            // An object that is filled like a list.
            Node::Called { .. } => (),
            _ => return Err((start, "an element of what is no list".into())),
        }
        Ok(())
    }

    fn set(&mut self, start: usize, elements: &[NodeId]) -> Result<(), Wrong> {
        let pairs = pairs(elements).ok_or((start, "a key without a value".to_owned()))?;
        let top = self.top()?;
        match &mut self.nodes[top as usize] {
            Node::Dict(items) | Node::Called { items, .. } => items.extend(pairs),
            _ => return Err((start, "an item of what is no dict".into())),
        }
        Ok(())
    }

    fn remember(&mut self, key: usize) -> Result<(), Wrong> {
        let top = self.top()?;
        self.memo.insert(key, top);
        Ok(())
    }

    fn recall(&mut self, start: usize, key: usize) -> Result<(), Wrong> {
        let known = self.memo.get(&key).copied().ok_or((start, format!("what was never remembered, {key}")))?;
        self.stack.push(known);
        Ok(())
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], Wrong> {
        let taken = self.some(N as u64)?;
        Ok(taken.try_into().expect("as many"))
    }

    fn some(&mut self, count: u64) -> Result<&[u8], Wrong> {
        let left = self.bytes.len() - self.at;
        let count = usize::try_from(count).ok().filter(|&count| count <= left);
        let count = count.ok_or((self.at, "the end of the pickle".to_owned()))?;
        self.at += count;
        Ok(&self.bytes[self.at - count..self.at])
    }

    /// A whole number of as many bytes as those before it say.
    fn long(&mut self, length_bytes: usize, start: usize) -> Result<(), Wrong> {
        let length = self.length(length_bytes)?;
        let digits = self.some(length)?;
        // Nine where the highest bit of eight would be taken for a sign.
        let digits = match digits {
            [eight @ .., 0] if eight.len() == 8 && eight[7] < 0x80 => eight,
            digits => digits,
        };
        if digits.len() > 8 {
            self.push(Node::Opaque);
            return Ok(());
        }
        let negative = digits.last().is_some_and(|last| last & 0x80 != 0);
        let mut wide = [if negative { 0xff } else { 0 }; 8];
        wide[..digits.len()].copy_from_slice(digits);
        self.push_int(i64::from_le_bytes(wide), start);
        Ok(())
    }

    /// A length of so many bytes.
    fn length(&mut self, bytes: usize) -> Result<u64, Wrong> {
        let mut wide = [0; 8];
        wide[..bytes].copy_from_slice(self.some(bytes as u64)?);
        Ok(u64::from_le_bytes(wide))
    }

    fn text(&mut self, length_bytes: usize) -> Result<(), Wrong> {
        let length = self.length(length_bytes)?;
        let start = self.at;
        let text = std::str::from_utf8(self.some(length)?).map(str::to_owned);
        self.push(Node::Text(text.map_err(|_| (start, "a text that is not UTF-8".to_owned()))?));
        Ok(())
    }

    fn blob(&mut self, length_bytes: usize) -> Result<(), Wrong> {
        let length = self.length(length_bytes)?;
        self.some(length)?;
        self.push(Node::Opaque);
        Ok(())
    }

    fn line(&mut self) -> Result<String, Wrong> {
        let start = self.at;
        let end = self.bytes[start..].iter().position(|&byte| byte == b'\n');
        let line = self.some(end.map_or(u64::MAX, |end| end as u64 + 1))?;
        let text =
            std::str::from_utf8(&line[..line.len() - 1]).map_err(|_| (start, "a name that is not UTF-8".to_owned()))?;
        Ok(text.to_owned())
    }
}

/// Keys and values by turns.
fn pairs(elements: &[NodeId]) -> Option<Vec<(NodeId, NodeId)>> {
    let (pairs, rest) = elements.as_chunks::<2>();
    rest.is_empty().then(|| pairs.iter().map(|&[key, value]| (key, value)).collect())
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn read(bytes: &[u8]) -> Pickle {
        Pickle::read(bytes).unwrap()
    }

    #[test]
    fn values_are_those_that_python_pickled() {
        // pickle.dumps(({"a": [1, -2, 300, 70000, 2**40], "b": (None, True, 0.5)}, "é"), 2)
        let bytes = b"\x80\x02}q\x00(X\x01\x00\x00\x00aq\x01]q\x02(K\x01J\xfe\xff\xff\xffM,\x01Jp\x11\x01\x00\x8a\x06\x00\x00\x00\x00\x00\x01eX\x01\x00\x00\x00bq\x03N\x88G?\xe0\x00\x00\x00\x00\x00\x00\x87q\x04uX\x02\x00\x00\x00\xc3\xa9q\x05\x86q\x06.";
        let pickle = read(bytes);
        let &[dict, text] = pickle.elements(pickle.root()).unwrap() else { panic!("a pair") };
        assert_eq!(pickle.text(text), Some("é"));
        let numbers = pickle.elements(pickle.item(dict, "a").unwrap()).unwrap();
        let numbers: Vec<i64> = numbers.iter().map(|&id| pickle.int(id).unwrap()).collect();
        assert_eq!(numbers, [1, -2, 300, 70_000, 1 << 40]);
        let others = pickle.elements(pickle.item(dict, "b").unwrap()).unwrap();
        let others: Vec<&Node> = others.iter().map(|&id| pickle.node(id)).collect();
        assert_eq!(others, [&Node::None, &Node::Bool(true), &Node::Float(0.5)]);
        assert_eq!(pickle.describe(dict), "a dict of 2: a, b");
    }

    #[test]
    fn numbers_written_anew_stand_where_the_old_ones_did() {
        // pickle.dumps((7, "x", 7), 4): in a frame, with a memo.
        let bytes = b"\x80\x04\x95\x0b\x00\x00\x00\x00\x00\x00\x00K\x07\x8c\x01x\x94K\x07\x87\x94.";
        let pickle = read(bytes);
        let elements = pickle.elements(pickle.root()).unwrap().to_vec();
        let Node::Int(7, at) = pickle.node(elements[2]) else { panic!("a number") };
        for number in [0, 255, 256, 65_535, 65_536, (1 << 31) - 1, 1 << 31, i64::MAX as u64] {
            let written = pickle.with_numbers(bytes, &BTreeMap::from([((at.start, at.end), number)]));
            let again = read(&written);
            let found = again.elements(again.root()).unwrap();
            assert_eq!((again.int(found[0]), again.text(found[1])), (Some(7), Some("x")));
            assert_eq!(again.int(found[2]), Some(number as i64));
        }
    }

    #[test]
    fn what_would_be_called_is_a_name_and_what_is_shared_is_there_once() {
        let bytes = b"\x80\x02cposix\nsystem\nX\x04\x00\x00\x00exit\x85R.";
        let pickle = read(bytes);
        assert_eq!(pickle.call(pickle.root()).unwrap().0, "posix.system");
        // A list of two of a list of two of …: 2^60 paths, a node for each list.
        let mut bytes = b"\x80\x02]q\x00".to_vec();
        for level in 0..60u8 {
            bytes.extend([b']', b'q', level + 1, b'(', b'h', level, b'h', level, b'e']);
        }
        bytes.push(b'.');
        assert_eq!(read(&bytes).ids().len(), 61);
        // One that is inside itself.
        let circle = read(b"\x80\x02]q\x00h\x00a.");
        assert_eq!(circle.elements(circle.root()), Some(&[circle.root()][..]));
        // Deeper than any stack.
        let deep = [b"\x80\x02)".to_vec(), b"\x85".repeat(1 << 20), b".".to_vec()].concat();
        assert_eq!(read(&deep).ids().len(), (1 << 20) + 1);
    }

    #[test]
    fn what_is_broken_is_told_with_its_place() {
        for (bytes, at, found) in [
            (&b""[..], 0, "end"),
            (b"\x80\x02K", 3, "end"),
            (b"\x80\x02X\xff\xff\xff\xffab", 7, "end"),
            (b"\x80\x02(K\x010", 6, "end"),
            (b"\x80\x02\x85.", 2, "tuple"),
            (b"\x80\x02h\x00.", 2, "remembered"),
            (b"\x80\x02}K\x01K\x02.", 8, ""),
            (b"\x80\x02}(K\x01u.", 6, "key without"),
            (b"\x80\x02\xff.", 2, "0xff"),
            (b"\x80\x02t.", 3, "never begun"),
        ] {
            match Pickle::read(bytes) {
                Err((place, said)) => assert!(place == at && said.contains(found), "{bytes:?}: {place}, {said}"),
                Ok(_) => assert!(found.is_empty(), "{bytes:?} was read"),
            }
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            if let Ok(pickle) = Pickle::read(&bytes) {
                pickle.ids().for_each(|id| drop(pickle.describe(id)));
                prop_assert!(pickle.ids().len() <= bytes.len());
            }
        }
    }
}
