//! Tests of pickles and JSON texts whose values take far more memory than the texts have bytes.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use flate2::write::DeflateEncoder;
use flate2::{Compression, Crc};

use crate::runner::{Folder, MIB, Outcome, SMALL_MEMORY, tiny_model};

/// Maximum number of bytes that the program accepts for a pickle in a checkpoint.
const LARGEST_PICKLE: usize = 8 << 20;

/// Bytes as a list of pieces, each with the number of its repetitions. Large inputs are written piece by piece, because
/// the memory of the test process counts in the runs that it starts.
type Pieces = Vec<(Vec<u8>, usize)>;

/// Returns `bytes` as a single piece without repetition.
fn once(bytes: &[u8]) -> Pieces {
    vec![(bytes.to_vec(), 1)]
}

/// Returns a pickle of almost [`LARGEST_PICKLE`] bytes: `start`, followed by repetitions of `piece`.
fn fill(start: &[u8], piece: &[u8]) -> Pieces {
    let block = piece.repeat(4096 / piece.len());
    let count = (LARGEST_PICKLE - start.len() - 4096) / block.len();
    vec![(start.to_vec(), 1), (block, count)]
}

/// File in a zip archive.
struct Entry {
    name: String,
    pieces: Pieces,
    /// Size and checksum of the decompressed content, if the entry is deflated.
    deflated: Option<(u32, u32)>,
}

impl Entry {
    fn stored(name: impl Into<String>, pieces: Pieces) -> Entry {
        Entry { name: name.into(), pieces, deflated: None }
    }

    /// Returns a deflated entry called `name` that contains `piece` `count` times.
    fn deflated(name: &str, piece: &[u8], count: usize) -> Entry {
        let (mut out, mut sum) = (DeflateEncoder::new(Vec::new(), Compression::best()), Crc::new());
        for _ in 0..count {
            out.write_all(piece).unwrap();
            sum.update(piece);
        }
        let deflated = Some(((piece.len() * count) as u32, sum.sum()));
        Entry { name: name.to_owned(), pieces: vec![(out.finish().unwrap(), 1)], deflated }
    }
}

/// Writes a zip archive with the files `entries` to `path`. Its directory declares `announced` entries; `None` stands
/// for the true number.
fn write_zip(path: &Path, entries: impl IntoIterator<Item = Entry>, announced: Option<u16>) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    let mut out = BufWriter::new(File::create(path).unwrap());
    let (mut at, mut directory, mut count) = (0u32, Vec::new(), 0u16);
    for Entry { name, pieces, deflated } in entries {
        let (mut sum, mut length) = (Crc::new(), 0);
        let repeated = || pieces.iter().flat_map(|(piece, count)| std::iter::repeat_n(piece, *count));
        for piece in repeated() {
            sum.update(piece);
            length += piece.len() as u32;
        }
        let (size, sum) = deflated.unwrap_or((length, sum.sum()));
        let method = if deflated.is_some() { 8u16 } else { 0 };
        let mut fields = vec![20, 0, 0, 0];
        fields.extend(method.to_le_bytes());
        fields.extend([0; 4]);
        for number in [sum, length, size] {
            fields.extend(number.to_le_bytes());
        }
        fields.extend((name.len() as u16).to_le_bytes());
        fields.extend([0; 2]);
        for part in [b"PK\x03\x04", &fields[..], name.as_bytes()].into_iter().chain(repeated().map(Vec::as_slice)) {
            out.write_all(part).unwrap();
        }
        directory.extend([b"PK\x01\x02\x14\0", &fields[..], &[0; 10], &at.to_le_bytes(), name.as_bytes()].concat());
        at += 30 + name.len() as u32 + length;
        count += 1;
    }
    out.write_all(&directory).unwrap();
    let count = announced.unwrap_or(count).to_le_bytes();
    let size = (directory.len() as u32).to_le_bytes();
    out.write_all(&[b"PK\x05\x06\0\0\0\0", &count[..], &count, &size, &at.to_le_bytes(), &[0, 0]].concat()).unwrap();
    out.flush().unwrap();
}

/// Writes a checkpoint with the pickle `pickle` to `path`.
fn write_checkpoint(path: &Path, pickle: Pieces) {
    write_zip(path, [Entry::stored("a/data.pkl", pickle), Entry::stored("a/version", once(b"3\n"))], None);
}

/// Copies the tiny model to `folder`. Its network is replaced by a checkpoint with `pickle`. Returns the name of the
/// copy.
fn model_with_network(folder: &Folder, pickle: Entry) -> &'static str {
    let cloud = "point_cloud/iteration_7/point_cloud.ply";
    for name in ["cfg_args", cloud] {
        folder.write(&format!("model/{name}"), fs::read(tiny_model().join(name)).unwrap());
    }
    write_zip(&folder.path("model/point_cloud/iteration_7/deformation.pth"), [pickle], None);
    "model"
}

/// Runs `info` on `input` with a memory limit of 64 MiB and checks that it keeps the limit.
fn info(folder: &Folder, input: &str) -> Outcome {
    folder.attack(&format!("info {input} --memory {}", SMALL_MEMORY.0)).run().within(SMALL_MEMORY.1)
}

/// Checks that a checkpoint is refused within the memory limit if its pickle begins with `start` and is filled with
/// repetitions of `piece`.
fn assert_flood_is_refused(start: &[u8], piece: &[u8]) {
    let folder = Folder::new();
    write_checkpoint(&folder.path("a.pt"), fill(start, piece));
    let outcome = info(&folder, "a.pt").refused(1, &["a.pt, data.pkl, byte ", "expected at most "]);
    let is_known = ["for the values of the pickle", "instructions"].iter().any(|part| outcome.stderr.contains(part));
    assert!(is_known, "{piece:?}: {}", outcome.stderr);
}

#[test]
fn many_pickled_lists_stay_within_memory() {
    assert_flood_is_refused(b"", b"]");
}

#[test]
#[ignore = "slow: reads a million pickle instructions several times"]
fn slow_many_pickle_instructions_stay_within_memory() {
    for (start, piece) in [
        (&b""[..], &b"}NNs"[..]),
        (b"", b"N\x85"),
        (b"", b"ca\nb\n"),
        (b"", b"(1"),
        (b"N", b"\x94"),
        (b"Nq\x00", b"h\x00"),
        (b"Nq\x00]", b"h\x00a"),
        (b"Nq\x00}", b"h\x00h\x00s"),
    ] {
        assert_flood_is_refused(start, piece);
    }
}

#[test]
fn shared_long_names_are_not_copied_for_each_use() {
    let folder = Folder::new();
    let length = 4u32 << 20;
    let pickle = vec![
        ([&b"X"[..], &length.to_le_bytes()].concat(), 1),
        (b"x".repeat(4096), 1024),
        (b"q\x00".to_vec(), 1),
        (b"h\x00h\x00\x93".to_vec(), 1000),
    ];
    write_checkpoint(&folder.path("a.pt"), pickle);
    info(&folder, "a.pt").refused(1, &["data.pkl, byte ", "for the values of the pickle", "--memory"]);
}

#[test]
fn deeply_nested_pickles_are_refused_by_their_depth() {
    let folder = Folder::new();
    let appended = once(&[&b"]".repeat(1000)[..], &b"a".repeat(999), b"."].concat());
    for pickle in [fill(b"", b"("), fill(b")", b"\x85"), appended] {
        write_checkpoint(&folder.path("a.pt"), pickle.clone());
        info(&folder, "a.pt").refused(1, &["data.pkl, byte ", "containers nested at most 100 deep"]);
        let model = model_with_network(&folder, Entry::stored("a/data.pkl", pickle));
        info(&folder, model).refused(1, &["deformation.pth, data.pkl, byte ", "containers nested at most 100 deep"]);
    }
}

#[test]
fn pickle_lengths_beyond_its_end_are_refused() {
    let folder = Folder::new();
    for start in [
        &b"\x80\x02\x8b\xff\xff\xff\x7f"[..],
        b"\x80\x02X\xff\xff\xff\xff",
        b"\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\xff",
        b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7f",
        b"\x80\x05\x96\xff\xff\xff\xff\xff\xff\xff\x7f",
        b"\x80\x02c",
    ] {
        write_checkpoint(&folder.path("a.pt"), once(&[start, b"abc"].concat()));
        info(&folder, "a.pt").refused(1, &["data.pkl, byte ", "the end of the pickle"]);
    }
}

#[test]
fn the_largest_memo_numbers_cost_no_memory() {
    let folder = Folder::new();
    write_checkpoint(&folder.path("a.pt"), once(b"\x80\x02Nr\xff\xff\xff\xffr\xfe\xff\xff\xff0j\xff\xff\xff\xff."));
    info(&folder, "a.pt").refused(1, &["a.pt: expected a supported model format"]);
}

#[test]
fn recursive_and_repeated_pickle_values_are_refused() {
    let folder = Folder::new();
    // Nested lists that contain the next level twice: 2^60 paths.
    let mut shared = b"\x80\x02}X\x01\x00\x00\x00a]q\x00".to_vec();
    for level in 0..60u8 {
        shared.extend([b']', b'q', level + 1, b'(', b'h', level, b'h', level, b'e']);
    }
    shared.extend(b"s.");
    let itself = b"\x80\x02}q\x00X\x01\x00\x00\x00ah\x00s.".to_vec();
    let list = b"\x80\x02}X\x01\x00\x00\x00a]q\x00h\x00as.".to_vec();
    for pickle in [shared, itself, list] {
        let model = model_with_network(&folder, Entry::stored("a/data.pkl", once(&pickle)));
        info(&folder, model).refused(1, &["deformation.pth"]);
    }
}

#[test]
fn a_deflated_pickle_is_refused_without_inflating_it() {
    let folder = Folder::new();
    // An archive of 25 KB that an earlier version inflated to 25 MB and read into 4.3 GB.
    let entry = || Entry::deflated("a/data.pkl", &b"]".repeat(1 << 20), 25);
    write_zip(&folder.path("a.pt"), [entry()], None);
    assert!(fs::metadata(folder.path("a.pt")).unwrap().len() < 40_000);
    let parts = ["data.pkl", "an uncompressed file, as torch.save writes it", "a compressed one", "torch.load"];
    info(&folder, "a.pt").refused(1, &parts);
    let model = model_with_network(&folder, entry());
    info(&folder, model).refused(1, &parts);
}

#[test]
fn many_empty_files_in_a_checkpoint_are_counted_first() {
    let folder = Folder::new();
    let name = |k: u32| format!("a/data/{k:020}");
    write_zip(&folder.path("a.pt"), (0..65_000).map(|k| Entry::stored(name(k), Vec::new())), None);
    info(&folder, "a.pt").refused(1, &["list of files", "the names of 65000 files", "--memory"]);
}

#[test]
fn checkpoint_declaring_billions_of_files_is_refused() {
    let folder = Folder::new();
    write_zip(&folder.path("b.pt"), [Entry::stored("a/data.pkl", once(b"N."))], Some(0xffff));
    let mut bytes = fs::read(folder.path("b.pt")).unwrap();
    let end = bytes.len() - 22;
    let tail = bytes.split_off(end);
    let at = bytes.len() as u64;
    // The 64-bit end records with the number of files, whose list begins at offset 0.
    bytes.extend([&b"PK\x06\x06"[..], &44u64.to_le_bytes(), &[45, 0, 45, 0], &[0; 8]].concat());
    bytes.extend([1u64 << 40, 1 << 40, 100, 0].iter().flat_map(|number| number.to_le_bytes()));
    bytes.extend([&b"PK\x06\x07"[..], &[0; 4], &at.to_le_bytes(), &[1, 0, 0, 0]].concat());
    bytes.extend(tail);
    folder.write("a.pt", bytes);
    info(&folder, "a.pt").refused(1, &["list of files", "1099511627776 files"]);
}

#[test]
fn repeated_keys_of_a_state_dict_do_not_add_up() {
    let folder = Folder::new();
    let pickle =
        vec![(b"\x80\x02}X\x01\x00\x00\x00aq\x000".to_vec(), 1), (b"h\x00Ns".to_vec(), 100_000), (b".".to_vec(), 1)];
    let model = model_with_network(&folder, Entry::stored("a/data.pkl", pickle));
    info(&folder, model).refused(1, &["deformation.pth"]);
}

#[test]
fn old_checkpoint_is_refused_with_a_remedy() {
    let folder = Folder::new();
    let old = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.".to_vec();
    let model = model_with_network(&folder, Entry::stored("a/data.pkl", once(b"N.")));
    folder.write("model/point_cloud/iteration_7/deformation.pth", &old);
    info(&folder, model).refused(1, &["deformation.pth", "convert it: python3 -c"]);
}

/// Creates the file at `path`, lets `write` write to it, and returns the path.
fn write_pieces(path: &Path, write: impl FnOnce(&mut BufWriter<File>)) -> PathBuf {
    let mut out = BufWriter::new(File::create(path).unwrap());
    write(&mut out);
    out.flush().unwrap();
    path.to_owned()
}

/// Returns the JSON of image number `k`, which has a camera of its own.
fn frame(k: u32) -> String {
    let x = f64::from(k) * 1e-3;
    format!(
        "{{\"file_path\": \"./train/r_{k:06}.png\", \"time\": {}, \"transform_matrix\": [[1.0, 0.0, 0.0, {x}], \
         [0.0, 0.0, -1.0, -4.0], [0.0, 1.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0]]}}",
        f64::from(k % 2)
    )
}

/// Writes a `transforms.json` with `count` images to `folder`.
fn write_transforms(folder: &Folder, count: u32) {
    write_pieces(&folder.path("transforms.json"), |out| {
        out.write_all(b"{\"camera_angle_x\": 1.0, \"w\": 32, \"h\": 32, \"frames\": [").unwrap();
        for k in 0..count {
            out.write_all(if k > 0 { b",\n" } else { b"\n" }).unwrap();
            out.write_all(frame(k).as_bytes()).unwrap();
        }
        out.write_all(b"]}").unwrap();
    });
}

/// Runs `compress --dry-run` on the tiny model with the cameras of `transforms.json` and the memory limit `memory`.
fn dry_run(folder: &Folder, memory: &str) -> Outcome {
    let line = format!("compress {{tiny}} -o out --cameras transforms.json --dry-run --explain --memory {memory}");
    folder.attack(&line).run().ended()
}

/// Returns the peak memory in bytes that the plan of a run states.
fn planned_memory(outcome: &Outcome) -> u64 {
    // The first figure is that of the whole run; memory used so far follows.
    let said = outcome.stdout.split("memory: at most ").nth(1).unwrap_or_else(|| panic!("{}", outcome.stdout));
    let mut words = said.split_whitespace();
    let number: f64 = words.next().unwrap().parse().unwrap();
    let unit = match words.next().unwrap() {
        "KiB" => 1024.0,
        "MiB" => MIB as f64,
        "GiB" => 1024.0 * MIB as f64,
        other => panic!("{other}"),
    };
    (number * unit) as u64
}

#[test]
fn memory_plan_covers_many_views() {
    let folder = Folder::new();
    write_transforms(&folder, 20_000);
    let outcome = dry_run(&folder, "512MiB").succeeded();
    let planned_memory = planned_memory(&outcome);
    outcome.within(planned_memory);
}

#[test]
fn more_views_than_fit_are_refused_with_their_number() {
    let folder = Folder::new();
    write_transforms(&folder, 20_000);
    let outcome = dry_run(&folder, "30MiB").refused(1, &["transforms.json", "--memory"]);
    outcome.within(SMALL_MEMORY.1);
}

#[test]
#[ignore = "slow: writes and reads 15 MB of JSON several times"]
fn slow_100_000_views_stay_within_memory_and_plan() {
    let folder = Folder::new();
    write_transforms(&folder, 100_000);
    dry_run(&folder, SMALL_MEMORY.0).refused(1, &["transforms.json", "--memory"]).within(SMALL_MEMORY.1);
    let outcome = dry_run(&folder, "256MiB").succeeded();
    let planned_memory = planned_memory(&outcome);
    outcome.within(planned_memory);
}

#[test]
#[ignore = "slow: writes and reads 165 MB of JSON"]
fn slow_165_mb_of_views_are_refused_within_memory() {
    let folder = Folder::new();
    write_transforms(&folder, 1_000_000);
    assert!(fs::metadata(folder.path("transforms.json")).unwrap().len() > 165_000_000);
    dry_run(&folder, SMALL_MEMORY.0).refused(1, &["transforms.json", "--memory"]).within(SMALL_MEMORY.1);
}

#[test]
fn huge_json_texts_numbers_and_nesting_are_refused() {
    let folder = Folder::new();
    for (start, piece) in [
        ("{\"note\": \"", "x".repeat(1 << 16)),
        ("{\"", "k".repeat(1 << 16)),
        ("{\"frames\": [{\"w2c\": \"", "\\n".repeat(1 << 15)),
        ("{\"w\": ", "7".repeat(1 << 16)),
        ("{\"note\": 0.", "0".repeat(1 << 16)),
        ("{\"note\": ", "[".repeat(1 << 16)),
        ("{\"note\": ", "{\"a\":".repeat(1 << 14)),
    ] {
        // The first length exceeds the memory limit, the second does not, and the text ends within the value.
        for (pieces, expected) in [(800, "--memory"), (50, "the end of the file within it")] {
            write_pieces(&folder.path("transforms.json"), |out| {
                out.write_all(start.as_bytes()).unwrap();
                (0..pieces).for_each(|_| out.write_all(piece.as_bytes()).unwrap());
            });
            let outcome = dry_run(&folder, SMALL_MEMORY.0).refused(1, &["transforms.json", expected]);
            outcome.within(SMALL_MEMORY.1);
        }
    }
}

#[test]
fn values_of_a_camera_that_are_too_long_are_not_kept() {
    let folder = Folder::new();
    for (key, expected) in [("\"transform_matrix\"", "found [0,0,0,"), ("\"other\"", "nothing")] {
        write_pieces(&folder.path("transforms.json"), |out| {
            write!(out, "{{\"camera_angle_x\": 1, \"w\": 32, \"h\": 32, \"frames\": [{}, {{{key}: [0", frame(0))
                .unwrap();
            (0..399_999).for_each(|_| out.write_all(b",0").unwrap());
            out.write_all(b"]}]}").unwrap();
        });
        let parts = ["transforms.json, frame 1, key \"transform_matrix\"", expected];
        dry_run(&folder, SMALL_MEMORY.0).refused(1, &parts).within(SMALL_MEMORY.1);
    }
}

#[test]
fn repeated_keys_in_json_do_not_add_up() {
    let folder = Folder::new();
    let frame = frame(0);
    folder.write(
        "transforms.json",
        format!("{{\"frames\": [{frame}], \"w\": 32, \"h\": 32, \"camera_angle_x\": 1, \"frames\": [{frame}]}}"),
    );
    dry_run(&folder, SMALL_MEMORY.0).refused(1, &["key \"frames\"", "this key once"]).within(SMALL_MEMORY.1);
    write_pieces(&folder.path("transforms.json"), |out| {
        write!(out, "{{\"camera_angle_x\": 1, \"h\": 32, \"frames\": [{frame}]").unwrap();
        (0..100_000).for_each(|k| write!(out, ", \"w\": 32, \"k{k}\": 1").unwrap());
        out.write_all(b"}").unwrap();
    });
    dry_run(&folder, SMALL_MEMORY.0).succeeded().within(SMALL_MEMORY.1);
}

#[test]
fn a_long_line_of_points_in_a_reconstruction_is_passed_over() {
    let folder = Folder::new();
    folder.write("sparse/0/cameras.txt", "1 PINHOLE 32 32 30 30 16 16\n");
    write_pieces(&folder.path("sparse/0/images.txt"), |out| {
        out.write_all(b"# images\n1 1 0 0 0 0 0 4 1 a.png\n").unwrap();
        (0..1_000_000).for_each(|_| out.write_all(b"12.25 17.5 -1 ").unwrap());
        out.write_all(b"\n2 1 0 0 0 0.1 0 4 1 b.png\n\n").unwrap();
    });
    let line = "compress {tiny} -o out --cameras sparse/0 --times none --dry-run --memory 64MiB";
    folder.attack(line).run().succeeded().within(SMALL_MEMORY.1);
    write_pieces(&folder.path("sparse/0/images.txt"), |out| {
        (0..1_000_000).for_each(|_| out.write_all(b"12.25 17.5 -1 ").unwrap());
    });
    let parts = ["images.txt, line 1", "a line of at most 65536 bytes"];
    folder.attack(line).run().refused(1, &parts).within(SMALL_MEMORY.1);
}

#[test]
fn pose_array_larger_than_memory_is_refused_by_its_header() {
    let folder = Folder::new();
    let header = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 17), }";
    let file =
        folder.write("poses_bounds.npy", [b"\x93NUMPY\x01\0\x76\0", format!("{header:117}\n").as_bytes()].concat());
    File::options().write(true).open(file).unwrap().set_len(128 + 1_000_000 * 17 * 8).unwrap();
    let line = "compress {tiny} -o out --cameras poses_bounds.npy --dry-run --memory 64MiB";
    let outcome = folder.attack(line).run().refused(1, &["poses_bounds.npy, data", "1000000 rows of 17", "--memory"]);
    outcome.within(SMALL_MEMORY.1);
}
