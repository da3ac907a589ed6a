use std::fs;
use std::io::Cursor;

use proptest::prelude::*;

use super::made::{PickledTensor, PythonValue, named, tensor, zip};
use super::*;
use crate::files::checkpoint::write::{GaussianRows, write_like};

struct TempCheckpoint(tempfile::TempDir);

impl TempCheckpoint {
    fn new() -> TempCheckpoint {
        TempCheckpoint(tempfile::tempdir().unwrap())
    }

    fn open(&self, bytes: &[u8]) -> Result<Checkpoint> {
        let path = self.0.path().join("a.pt");
        fs::write(&path, bytes).unwrap();
        Checkpoint::open(&path, ReadLimit::NONE)
    }

    fn path(&self) -> PathBuf {
        self.0.path().join("left.pt")
    }

    fn reduced(&self, from: &Checkpoint, kept: &[u32], rows: &[GaussianRows]) -> Result<Checkpoint> {
        let path = self.path();
        write_like(from, kept, rows, &path)?;
        Checkpoint::open(&path, ReadLimit::NONE)
    }
}

fn ramp(n: usize) -> Vec<f32> {
    (0..n).map(|i| i as f32 + 0.5).collect()
}

/// Returns a tuple of two dicts to be written as a checkpoint. They contain:
///
/// - tensors with one row for each of four Gaussians; one of them is a transposed parameter, and two share a storage
///   (block of values)
/// - a tensor whose rows are not Gaussians (`net`)
/// - a mask: one boolean per Gaussian
/// - values that are not tensors
fn model() -> PythonValue {
    let transposed = PickledTensor { stride: vec![1, 4], ..tensor(1, &[4, 3], &ramp(12)) };
    let [first, second] =
        [0, 12].map(|offset| PickledTensor { offset, shape: vec![4, 3], ..tensor(3, &[4, 3], &ramp(24)) });
    let mask = PickledTensor { class: "BoolStorage", width: 1, bytes: vec![1, 0, 1, 1], ..tensor(4, &[4], &[]) };
    PythonValue::Tuple(vec![
        PythonValue::Dict(named(vec![
            ("means", PythonValue::Tensor(tensor(0, &[4, 3], &ramp(12)))),
            ("turned", PythonValue::Parameter(transposed)),
            ("net", PythonValue::Tensor(tensor(2, &[2, 2], &ramp(4)))),
        ])),
        PythonValue::Ordered(named(vec![
            ("first", PythonValue::Tensor(first)),
            ("second", PythonValue::Tensor(second)),
            ("mask", PythonValue::Tensor(mask)),
            ("step", PythonValue::Int(7)),
            ("rate", PythonValue::Float(0.25)),
            ("text", PythonValue::Text("abc")),
            ("nothing", PythonValue::List(vec![PythonValue::None, PythonValue::Bool(true)])),
        ])),
    ])
}

fn find(checkpoint: &Checkpoint, part: usize, name: &str) -> TensorView {
    let pickle = checkpoint.pickle();
    let parts = pickle.elements(pickle.root()).unwrap();
    checkpoint.tensor(pickle.item(parts[part], name).unwrap()).unwrap()
}

fn values(checkpoint: &Checkpoint, part: usize, name: &str) -> Vec<f32> {
    checkpoint.values(&find(checkpoint, part, name), name).unwrap()
}

#[test]
fn tensor_values_are_independent_of_strides_and_storages() {
    let temp = TempCheckpoint::new();
    let checkpoint = temp.open(&model().file()).unwrap();
    assert_eq!(values(&checkpoint, 0, "means"), ramp(12));
    let turned: Vec<f32> = (0..4).flat_map(|row| (0..3).map(move |c| (row + 4 * c) as f32 + 0.5)).collect();
    assert_eq!(values(&checkpoint, 0, "turned"), turned);
    assert_eq!(values(&checkpoint, 1, "second"), ramp(24)[12..]);
    assert_eq!(checkpoint.tensors().count(), 6);
    let mask = find(&checkpoint, 1, "mask");
    assert_eq!(mask.describe(), "bool [4]");
    let error = checkpoint.float_tensor(mask.id, "mask").unwrap_err().to_string();
    assert!(error.contains("a.pt, mask") && error.contains("bool [4]"), "{error}");
}

#[test]
fn every_float_type_is_converted_to_f32() {
    let temp = TempCheckpoint::new();
    let checkpoint_of_type = |class, width, bytes: Vec<u8>| {
        let shape = vec![bytes.len() / width];
        PythonValue::Tensor(PickledTensor { class, width, bytes, ..tensor(0, &shape, &[]) }).file()
    };
    let le16 = |values: &[u16]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    for (class, width, bytes, expected) in [
        ("HalfStorage", 2, le16(&[0x3C00, 0xC000, 1]), vec![1.0, -2.0, 2f32.powi(-24)]),
        ("BFloat16Storage", 2, le16(&[0x3F80, 0xC000, 1]), vec![1.0, -2.0, 2f32.powi(-133)]),
        ("DoubleStorage", 8, 0.1f64.to_le_bytes().to_vec(), vec![0.1]),
        ("FloatStorage", 4, 0.1f32.to_le_bytes().to_vec(), vec![0.1]),
    ] {
        let checkpoint = temp.open(&checkpoint_of_type(class, width, bytes)).unwrap();
        let tensor = checkpoint.float_tensor(checkpoint.pickle().root(), "t").unwrap();
        assert_eq!(checkpoint.values(&tensor, "t").unwrap(), expected, "{class}");
    }
}

/// Checks that a checkpoint in the format of PyTorch before 1.6 is refused with a message that says how to convert it.
/// The test bytes are the start of a file that `torch.save(…, _use_new_zipfile_serialization=False)` writes.
#[test]
fn files_of_old_pytorch_are_refused_with_advice() {
    let start = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.\x80\x02M\xe9\x03.";
    let error = TempCheckpoint::new().open(start).unwrap_err().to_string();
    for part in ["a.pt", "PyTorch 1.6", "the older format", "torch.load('OLD'"] {
        assert!(error.contains(part), "{part}: {error}");
    }
}

#[test]
fn kept_rows_and_everything_else_are_unchanged() {
    let temp = TempCheckpoint::new();
    let checkpoint = temp.open(&model().file()).unwrap();
    let rows_of = |part, name, changed: &[u32], values: &[f32]| GaussianRows {
        tensor: find(&checkpoint, part, name),
        changed: changed.to_vec(),
        values: values.to_vec(),
    };
    let rows = [
        rows_of(0, "means", &[1], &[-1.0, -2.0, -3.0]),
        rows_of(0, "turned", &[0], &[-4.0, -5.0, -6.0]),
        rows_of(1, "first", &[], &[]),
        rows_of(1, "second", &[1], &[]),
        rows_of(1, "mask", &[], &[]),
    ];
    let reduced = temp.reduced(&checkpoint, &[1, 3], &rows).unwrap();
    assert_eq!(values(&reduced, 0, "means"), [3.5, 4.5, 5.5, -1.0, -2.0, -3.0]);
    assert_eq!(values(&reduced, 0, "turned"), [-4.0, -5.0, -6.0, 3.5, 7.5, 11.5]);
    // The transposed tensor is still stored column by column.
    assert_eq!(find(&reduced, 0, "turned").stride, [1, 2]);
    assert_eq!(values(&reduced, 0, "net"), ramp(4));
    assert_eq!(values(&reduced, 1, "first"), [3.5, 4.5, 5.5, 9.5, 10.5, 11.5]);
    assert_eq!(values(&reduced, 1, "second"), [15.5, 16.5, 17.5, 0.0, 0.0, 0.0]);
    assert_eq!(reduced.storage("4").unwrap(), [0, 1]);
    assert_eq!(reduced.storage("3").unwrap().len(), 4 * 12);
    // The pickles may differ only in numbers, and the archives must hold the same files in the same order.
    let texts = |checkpoint: &Checkpoint| {
        let describe = |id| match checkpoint.pickle().node(id) {
            Node::Int(..) => "a number".to_owned(),
            other => format!("{other:?}"),
        };
        checkpoint.pickle().ids().map(describe).collect::<Vec<_>>()
    };
    assert_eq!(texts(&reduced), texts(&checkpoint));
    let names = |checkpoint: &Checkpoint| {
        let mut names = Vec::new();
        checkpoint
            .files(|name, _, _| {
                names.push(name.to_owned());
                Ok(())
            })
            .unwrap();
        names
    };
    assert_eq!(names(&reduced), names(&checkpoint));
    // Writing the same content again must give the same bytes.
    let bytes = fs::read(temp.path()).unwrap();
    temp.reduced(&checkpoint, &[1, 3], &rows).unwrap();
    assert_eq!(fs::read(temp.path()).unwrap(), bytes);
    for (at, name) in [(0, "made/data.pkl"), (2, "made/data/0")] {
        let mut archive = ZipArchive::new(Cursor::new(&bytes[..])).unwrap();
        let file = archive.by_index(at).unwrap();
        assert!(
            file.name() == name && file.data_start().is_multiple_of(64),
            "{} at {}",
            file.name(),
            file.data_start()
        );
    }
}

#[test]
fn keeping_all_rows_keeps_all_bytes() {
    let temp = TempCheckpoint::new();
    let checkpoint = temp.open(&model().file()).unwrap();
    let rows = [(0, "means"), (0, "turned"), (1, "mask")].map(|(part, name)| GaussianRows {
        tensor: find(&checkpoint, part, name),
        changed: Vec::new(),
        values: Vec::new(),
    });
    let reduced = temp.reduced(&checkpoint, &[0, 1, 2, 3], &rows).unwrap();
    let all = |checkpoint: &Checkpoint| {
        let mut files = Vec::new();
        checkpoint
            .files(|name, what, bytes| {
                files.push((name.to_owned(), what != CheckpointFile::Pickle, bytes));
                Ok(())
            })
            .unwrap();
        files.into_iter().filter(|file| file.1).collect::<Vec<_>>()
    };
    assert_eq!(all(&reduced), all(&checkpoint));
}

#[test]
fn a_shared_shape_is_refused_if_one_tensor_changes() {
    let temp = TempCheckpoint::new();
    let file = PythonValue::Tuple(vec![
        PythonValue::Tensor(tensor(0, &[3, 3], &ramp(9))),
        PythonValue::Tensor(tensor(1, &[3, 3], &ramp(9))),
    ]);
    let whole = file.file();
    let checkpoint = temp.open(&whole).unwrap();
    let mut files = Vec::new();
    checkpoint
        .files(|name, _, bytes| {
            files.push((without_first_folder(name).to_owned(), bytes));
            Ok(())
        })
        .unwrap();
    // Store the first shape in the pickle's memo (table for repeated values), and use it in place of the second shape.
    let shape = [&b"(J\x03\0\0\0J\x03\0\0\0t"[..]].concat();
    let pickle = &mut files[0].1;
    let found: Vec<usize> = (0..pickle.len() - shape.len()).filter(|&at| pickle[at..].starts_with(&shape)).collect();
    pickle.splice(found[1]..found[1] + shape.len(), [b'h', 9]);
    pickle.splice(found[0] + shape.len()..found[0] + shape.len(), [b'q', 9]);
    let checkpoint = temp.open(&zip(&files)).unwrap();
    let id = |k: usize| checkpoint.pickle().elements(checkpoint.pickle().root()).unwrap()[k];
    let rows_of =
        |k| GaussianRows { tensor: checkpoint.tensor(id(k)).unwrap(), changed: Vec::new(), values: Vec::new() };
    let error = temp.reduced(&checkpoint, &[0], &[rows_of(0)]).unwrap_err().to_string();
    assert!(error.contains("several share") && error.contains("clone()"), "{error}");
    // If both tensors change, their common shape still holds for both.
    temp.reduced(&checkpoint, &[0], &[rows_of(0), rows_of(1)]).unwrap();
}

#[test]
fn incomplete_tensors_and_files_are_named() {
    let temp = TempCheckpoint::new();
    let message = |tensor: PickledTensor| {
        let checkpoint = temp.open(&PythonValue::Tensor(tensor).file()).unwrap();
        checkpoint.float_tensor(checkpoint.pickle().root(), "means").unwrap_err().to_string()
    };
    let valid = || tensor(0, &[4, 3], &ramp(12));
    for wrong in [
        PickledTensor { shape: vec![5, 3], ..valid() },
        PickledTensor { offset: 1, ..valid() },
        PickledTensor { shape: vec![1 << 20, 1 << 10], stride: vec![0, 0], ..valid() },
        PickledTensor { shape: vec![i32::MAX as usize; 4], stride: vec![i32::MAX as usize; 4], ..valid() },
        PickledTensor { bytes: Vec::new(), ..valid() },
    ] {
        let error = message(wrong);
        assert!(error.contains("means") && error.contains("data/0"), "{error}");
    }
    let no_rank = message(PickledTensor { stride: vec![1], ..valid() });
    assert!(no_rank.contains("_rebuild_tensor_v2"), "{no_rank}");
    // The archive lacks the file that holds the values of the tensor.
    let checkpoint = temp.open(&PythonValue::Tensor(valid()).file()).unwrap();
    let mut files = Vec::new();
    checkpoint
        .files(|name, _, bytes| {
            files.push((without_first_folder(name).to_owned(), bytes));
            Ok(())
        })
        .unwrap();
    files.retain(|(name, _)| name != "data/0");
    let checkpoint = temp.open(&zip(&files)).unwrap();
    let error = checkpoint.float_tensor(checkpoint.pickle().root(), "means").unwrap_err().to_string();
    assert!(error.contains("no file data/0"), "{error}");
    let error = temp.open(&zip(&files[1..])).unwrap_err().to_string();
    assert!(error.contains("no data.pkl"), "{error}");
}

#[test]
fn truncated_and_damaged_files_never_give_wrong_values() {
    let temp = TempCheckpoint::new();
    let whole = model().file();
    for length in (0..whole.len()).step_by(7) {
        let error = temp.open(&whole[..length]).expect_err("a cut file must be refused").to_string();
        assert!(error.contains("a.pt"), "{error}");
    }
    let expected = values(&temp.open(&whole).unwrap(), 0, "means");
    let root = |checkpoint: &Checkpoint| -> Option<TensorView> {
        let pickle = checkpoint.pickle();
        checkpoint.tensor(pickle.item(*pickle.elements(pickle.root())?.first()?, "means")?)
    };
    for at in (0..whole.len()).step_by(3) {
        let mut bytes = whole.clone();
        bytes[at] ^= 1 << (at % 8);
        let Ok(checkpoint) = temp.open(&bytes) else { continue };
        let Some(tensor) = root(&checkpoint) else { continue };
        if let Ok(tensor) = checkpoint.float_tensor(tensor.id, "means")
            && let Ok(found) = checkpoint.values(&tensor, "means")
        {
            assert_eq!(found, expected, "byte {at}");
        }
    }
}

proptest! {
    #[test]
    fn hostile_pickles_are_read_or_refused(pickle in proptest::collection::vec(any::<u8>(), 0..300), flips in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4)) {
        let temp = TempCheckpoint::new();
        let read_and_rewrite = |bytes: &[u8]| {
            let Ok(checkpoint) = temp.open(bytes) else { return };
            for tensor in checkpoint.tensors() {
                if let Ok(tensor) = checkpoint.float_tensor(tensor.id, "t") {
                    _ = checkpoint.values(&tensor, "t");
                }
                if !tensor.shape.is_empty() {
                    let rows = [GaussianRows { tensor, changed: Vec::new(), values: Vec::new() }];
                    _ = temp.reduced(&checkpoint, &[], &rows);
                }
            }
        };
        read_and_rewrite(&zip(&[("data.pkl".to_owned(), pickle)]));
        let mut files = Vec::new();
        temp.open(&model().file()).unwrap().files(|name, _, bytes| {
            files.push((without_first_folder(name).to_owned(), bytes));
            Ok(())
        }).unwrap();
        for (at, to) in flips {
            let at = at.index(files[0].1.len());
            files[0].1[at] = to;
        }
        read_and_rewrite(&zip(&files));
    }
}
