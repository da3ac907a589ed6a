//! Reads and writes PyTorch state dicts (`.pth`), which map names to tensors. Tensors are read as f32.

mod write;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use crate::deform::{Tensor, Tensors};
use crate::error::{Error, Result, quoted};
use crate::files::checkpoint::{Checkpoint, MAX_DEPTH, Node, NodeId, TensorView};
use crate::files::names::shown_name;
use crate::limits::ReadLimit;
pub(crate) use write::{StoredTensor, TensorValues, write_state_dict};

/// Maximum ratio of the bytes of all tensors in a file to the size of the file. The limit is needed because a tensor
/// may repeat stored values (stride 0), so a small file can declare a huge tensor. No trained state dict has a larger
/// ratio.
pub(crate) const MAX_EXPANSION: u64 = 4;
/// Maximum length of the name of a tensor in bytes.
const MAX_NAME_BYTES: usize = 1024;
/// Bytes of memory of one tensor, without its name and values.
const TENSOR_BYTES: u64 = 512;

/// Reads every floating-point tensor of the state dict at `path`, widened or rounded to f32. Integer and boolean
/// tensors are left out.
///
/// Memory: the tensors (at most four times the size of the file) and the bytes of one storage (block of tensor values);
/// together at most `memory`.
///
/// # Errors
/// Fails if the file is not a state dict, is truncated or damaged, declares more values than it can hold, or takes more
/// memory than allowed.
pub(crate) fn read_state_dict(path: &Path, memory: ReadLimit) -> Result<Tensors> {
    read_state_dict_with_note(path, memory).map(|(tensors, _)| tensors)
}

/// Reads tensors like [`read_state_dict`]. The names of all tensors may begin with a prefix that a wrapper of the model
/// (such as `torch.compile`) added. It is removed, and a note for the user says so. Returns the tensors and this note,
/// if there is one.
///
/// # Errors
/// Fails like [`read_state_dict`].
pub(crate) fn read_state_dict_with_note(path: &Path, memory: ReadLimit) -> Result<(Tensors, Option<String>)> {
    let file_bytes = fs::metadata(path).map_err(Error::io("open", path))?.len();
    let dict = StateDict::open(path, memory)?;
    let bytes = |tensor: &TensorView, width: usize| {
        tensor.len().map_or(u64::MAX, |len| (len as u64).saturating_mul(width as u64))
    };
    let sum = |width: fn(&TensorView) -> usize| {
        dict.tensors.values().fold(0u64, |sum, tensor| sum.saturating_add(bytes(tensor, width(tensor))))
    };
    let declared = sum(|tensor| tensor.kind.bytes());
    if declared > file_bytes.saturating_mul(MAX_EXPANSION) {
        return Err(Error::input(
            path,
            "",
            format!("at most {MAX_EXPANSION} times its {file_bytes} bytes of tensors"),
            format!("tensors of {declared} bytes"),
        ));
    }
    dict.checkpoint.allow("", "its tensors", sum(|tensor| if tensor.kind.is_float() { 4 } else { 0 }))?;
    let mut tensors = Tensors::new();
    for (name, tensor) in &dict.tensors {
        let place = format!("tensor {name}");
        dict.checkpoint
            .check_extent(tensor)
            .map_err(|found| dict.checkpoint.wrong(&place, "values for all of its elements", found))?;
        if tensor.kind.is_float() {
            let data = dict.checkpoint.values(tensor, &place)?;
            tensors.insert(name.clone(), Tensor { shape: tensor.shape.clone(), data });
        }
    }
    let note = (!dict.prefix.is_empty()).then(|| format!("{}: {}", shown_name(path), wrapper_note(&dict.prefix)));
    Ok((tensors, note))
}

/// Returns the note for the user that says that `prefix` was removed from the names of all tensors.
pub(crate) fn wrapper_note(prefix: &str) -> String {
    format!("the names of all tensors begin with {}, of a wrapper of the model; read without it", quoted(prefix))
}

/// Returns the names of the tensors of the state dict at `path`, in order. No values are read.
///
/// # Errors
/// Fails if the file is not a state dict.
pub(crate) fn names(path: &Path, memory: ReadLimit) -> Result<Vec<String>> {
    Ok(StateDict::open(path, memory)?.tensors.into_keys().collect())
}

/// Returns whether all tensors of the state dict at `path` are floating-point, so that [`read_state_dict`] leaves out
/// none.
///
/// # Errors
/// Fails if the file is not a state dict.
pub(crate) fn is_floating(path: &Path, memory: ReadLimit) -> Result<bool> {
    Ok(StateDict::open(path, memory)?.tensors.values().all(|tensor| tensor.kind.is_float()))
}

/// Returns whether the file at `path` holds a tuple of two values instead of a state dict. Grid4D saves such files,
/// with two state dicts. Returns false for a file that cannot be read.
pub(crate) fn is_pair(path: &Path, memory: ReadLimit) -> bool {
    Checkpoint::open(path, memory).is_ok_and(|checkpoint| {
        let pickle = checkpoint.pickle();
        matches!(pickle.node(pickle.root()), Node::Tuple(parts) if parts.len() == 2)
    })
}

/// Tensors of a checkpoint by name. The name of a tensor in nested dicts, lists or tuples consists of all keys, joined
/// by dots.
struct StateDict {
    checkpoint: Checkpoint,
    /// Tensors by their names, from which `prefix` has been removed.
    tensors: BTreeMap<String, TensorView>,
    /// Prefix of the names of all tensors in the file, which a wrapper of the model (such as `torch.compile`) added;
    /// empty if there is none.
    prefix: String,
}

/// Prefixes that `torch.nn.DataParallel` and `torch.compile` add to the names of all tensors.
const WRAPPERS: [&str; 2] = ["module.", "_orig_mod."];

/// Returns whether there is at least one tensor, and every name begins with `prefix` and is longer than `prefix`.
fn all_begin_with(tensors: &BTreeMap<String, TensorView>, prefix: &str) -> bool {
    !tensors.is_empty() && tensors.keys().all(|name| name.len() > prefix.len() && name.starts_with(prefix))
}

impl StateDict {
    /// Opens the checkpoint at `path` and finds its tensors.
    ///
    /// # Errors
    /// Fails if the checkpoint is invalid or not a dict, or if a value seems to be a tensor of an unknown kind.
    fn open(path: &Path, memory: ReadLimit) -> Result<StateDict> {
        let checkpoint = Checkpoint::open(path, memory)?;
        let (root, nodes) = (checkpoint.pickle().root(), checkpoint.pickle().ids().len());
        if checkpoint.pickle().pairs(root).is_none() {
            return Err(checkpoint
                .wrong("data.pkl", "a state dict written by torch.save", checkpoint.describe(root))
                .hint("save the model again with torch.save(model.state_dict(), path)"));
        }
        // Limit the number of visits: a shared value is visited once for each of its names, and a pickle can give a
        // value any number of names.
        let mut search = TensorSearch {
            checkpoint: &checkpoint,
            remaining_visits: 4 * nodes + 1000,
            name_bytes: 0,
            tensors: BTreeMap::new(),
        };
        search.visit(root, &mut String::new(), 0)?;
        let mut tensors = search.tensors;
        let mut prefix = String::new();
        while let Some(wrapper) = WRAPPERS.iter().find(|wrapper| all_begin_with(&tensors, wrapper)) {
            tensors = tensors.into_iter().map(|(name, tensor)| (name[wrapper.len()..].to_owned(), tensor)).collect();
            prefix += wrapper;
        }
        Ok(StateDict { checkpoint, tensors, prefix })
    }
}

/// State of the search for tensors in the object tree of a pickle.
struct TensorSearch<'a> {
    checkpoint: &'a Checkpoint,
    /// Number of nodes of the object tree that may still be visited before the search fails.
    remaining_visits: usize,
    /// Bytes of memory that the names and descriptions of the tensors found so far take, without their values.
    name_bytes: u64,
    tensors: BTreeMap<String, TensorView>,
}

impl TensorSearch<'_> {
    /// Searches for tensors in the object tree of a pickle, from node `id` downward, and adds them to `tensors`. `name`
    /// is the name of the node: the keys that lead to it, joined by dots. `depth` is the number of these keys. Fails if
    /// the tree is too deep or too large, or if a value seems to be a tensor of an unknown kind.
    fn visit(&mut self, id: NodeId, name: &mut String, depth: u8) -> Result<()> {
        let (checkpoint, pickle) = (self.checkpoint, self.checkpoint.pickle());
        self.remaining_visits = self
            .remaining_visits
            .checked_sub(1)
            .filter(|_| depth <= MAX_DEPTH && name.len() <= MAX_NAME_BYTES)
            .ok_or_else(|| {
                let expected = format!("a tree of tensors with names of at most {MAX_NAME_BYTES} bytes");
                checkpoint.wrong("data.pkl", expected, "values that contain one another, or longer names")
            })?;
        if let Some(tensor) = checkpoint.tensor(id) {
            self.name_bytes += name.len() as u64 + TENSOR_BYTES;
            checkpoint.allow("data.pkl", "the list of its tensors", self.name_bytes)?;
            self.tensors.insert(name.clone(), tensor);
            return Ok(());
        }
        if let Some(pairs) = pickle.pairs(id) {
            for &(key, value) in pairs {
                let part = match pickle.node(key) {
                    Node::Text(text) => text.to_string(),
                    Node::Int(number, _) => number.to_string(),
                    _ => {
                        let place = format!("data.pkl, {}", named(name));
                        return Err(checkpoint.wrong(&place, "names as keys", checkpoint.describe(key)));
                    }
                };
                self.visit_part(value, name, &part, depth)?;
            }
        } else if let Some(elements) = pickle.elements(id) {
            for (index, &element) in elements.iter().enumerate() {
                self.visit_part(element, name, &index.to_string(), depth)?;
            }
        } else if let Some((callee, arguments)) = pickle.call(id) {
            // Report a tensor of an unknown kind instead of leaving it out.
            let is_unsigned = callee == "torch._utils._rebuild_tensor_v3";
            if !is_unsigned && arguments.iter().any(|&id| self.holds_values(id)) {
                let place = format!("tensor {}", named(name));
                return Err(checkpoint.wrong(&place, "a dense tensor or parameter", pickle.describe(id)));
            }
        }
        Ok(())
    }

    /// Searches for tensors from node `id` downward, like [`TensorSearch::visit`]. The node is a child, with the key
    /// `part`, of another node: `name` is the name of that parent node and `depth` its depth in the object tree.
    fn visit_part(&mut self, id: NodeId, name: &mut String, part: &str, depth: u8) -> Result<()> {
        let before = name.len();
        if before > 0 {
            name.push('.');
        }
        name.push_str(part);
        self.visit(id, name, depth + 1)?;
        name.truncate(before);
        Ok(())
    }

    /// Returns whether node `id` is a tensor or a storage (block of tensor values).
    fn holds_values(&self, id: NodeId) -> bool {
        matches!(self.checkpoint.pickle().node(id), Node::PersistentId(_)) || self.checkpoint.tensor(id).is_some()
    }
}

/// Returns the name of a tensor as it is quoted in messages.
fn named(name: &str) -> String {
    if name.is_empty() { "the root".to_owned() } else { quoted(name).to_string() }
}

#[cfg(test)]
mod tests;
