//! Readers of user-supplied bytes, each as a function of those bytes. The saved corpus (`tests/corpus`) and the fuzz
//! targets (`fuzz`) run them.
//!
//! Input: bytes. Result: success, or the message that refuses the bytes. Formats with checksums are read a second time
//! with repaired checksums; otherwise no code behind the checksums would be reached.

use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};

use flate2::Crc;
use splatsieve::archive;
use splatsieve::files::cameras;
use splatsieve::files::cameras::CameraOptions;
use splatsieve::files::container::Container;
use splatsieve::files::frame_stream::FrameStream;
use splatsieve::files::parser_checks;
use splatsieve::files::ply::check_header;
use splatsieve::limits::ReadLimit;
use splatsieve::model::{Attributes, Gaussians};
use splatsieve::models;
use splatsieve::models::OpenOptions;
use splatsieve::models::archive::{restored_output_kind, unpack};
use splatsieve::outputs::kind::OutputKind;
use splatsieve::passes::gather;
use splatsieve::recipe::Recipe;
use splatsieve::source::FrameSource;
use xxhash_rust::xxh3::xxh3_64;

use crate::memory;

/// Success, or the reason why the bytes were refused.
pub(crate) type Outcome = Result<(), Box<dyn Error>>;

/// Reader of user-supplied bytes, with its memory limit.
pub(crate) struct Entry {
    /// Name of the fuzz target.
    pub(crate) name: &'static str,
    /// Name of the folder with saved inputs of this reader in the corpus.
    pub(crate) corpus: &'static str,
    /// Function that reads the bytes; it may write to the folder.
    pub(crate) read: fn(&[u8], &InputFolder) -> Outcome,
    /// Function that returns the bytes with every checksum repaired, or `None` if the format has none or they cannot be
    /// located.
    pub(crate) repair_checksums: fn(&[u8]) -> Option<Vec<u8>>,
    /// Maximum number of bytes that the reader may have allocated at any time, in addition to [`PER_BYTE`] for each
    /// byte read.
    pub(crate) most_bytes: usize,
}

impl Entry {
    /// Calls the reader with `bytes` as they are, and with repaired checksums. The reader may write to `folder`.
    ///
    /// # Panics
    /// Panics if the reader panics, uses more memory than the limit, or reports an error in Rust terms.
    pub(crate) fn check(&self, bytes: &[u8], folder: &InputFolder) {
        self.check_one(bytes, folder);
        if let Some(repaired) = (self.repair_checksums)(bytes).filter(|repaired| repaired != bytes) {
            self.check_one(&repaired, folder);
        }
    }

    fn check_one(&self, bytes: &[u8], folder: &InputFolder) {
        let (outcome, peak) = memory::peak(|| (self.read)(bytes, folder));
        let most = self.most_bytes + PER_BYTE * bytes.len();
        assert!(peak <= most, "{} bytes took {peak} of memory: expected at most {most}", bytes.len());
        let message = outcome.err().map(|error| error.to_string()).unwrap_or_default();
        // A message may quote the file.
        let own = |term: &str| !bytes.windows(term.len()).any(|part| part == term.as_bytes());
        let found = RUST_DEBUG_TEXT.iter().find(|term| message.contains(*term) && own(term));
        assert!(found.is_none(), "a message with {found:?} in it: {message}");
    }
}

/// Texts that occur only in Rust debug output.
const RUST_DEBUG_TEXT: [&str; 11] =
    ["Some(", "None)", "Ok(", "Err(", "Error(", "Error {", "ErrorKind", "Custom {", "Id {", "Record {", "Stats {"];

/// Number of bytes that a reader may allocate for each byte read, in addition to its own limit.
pub(crate) const PER_BYTE: usize = 512;

/// Memory limit of most readers, in bytes.
const SMALL_BYTES: usize = 32 << 20;
/// Memory limit of the reader of pickles, in bytes: the 1 MiB that it is given, and space for messages.
const PICKLE_BYTES: usize = (1 << 20) + (64 << 10);
/// Memory limit of the reader of containers, in bytes. A tile may hold 256 MiB (format/SPEC.md), decoded next to its
/// encoded bytes.
const CONTAINER_BYTES: usize = 640 << 20;
/// Memory limit of the reader of archives, in bytes. An archive may decode to 64 MiB plus 512 times its own bytes
/// (format/ARCHIVE.md).
const ARCHIVE_BYTES: usize = 256 << 20;

/// List of all readers of user-supplied bytes.
pub(crate) const ENTRIES: [Entry; 24] = [
    Entry {
        name: "archive",
        corpus: "archive",
        read: archive,
        repair_checksums: repair_archive,
        most_bytes: ARCHIVE_BYTES,
    },
    Entry {
        name: "archive_sections",
        corpus: "archive_sections",
        read: archive_sections,
        repair_checksums: |_| None,
        most_bytes: ARCHIVE_BYTES,
    },
    Entry { name: "cameras", corpus: "cameras", read: cameras, repair_checksums: |_| None, most_bytes: SMALL_BYTES },
    Entry { name: "cfg_args", corpus: "cfg_args", read: cfg_args, repair_checksums: |_| None, most_bytes: SMALL_BYTES },
    Entry {
        name: "checkpoint",
        corpus: "checkpoint",
        read: checkpoint,
        repair_checksums: repair_zip,
        most_bytes: SMALL_BYTES,
    },
    Entry { name: "colmap", corpus: "colmap", read: colmap, repair_checksums: |_| None, most_bytes: SMALL_BYTES },
    Entry {
        name: "container",
        corpus: "container",
        read: container,
        repair_checksums: repair_container,
        most_bytes: CONTAINER_BYTES,
    },
    Entry { name: "deform", corpus: "deform", read: deform, repair_checksums: repair_zip, most_bytes: SMALL_BYTES },
    Entry { name: "ftgs", corpus: "ftgs", read: ftgs, repair_checksums: |_| None, most_bytes: SMALL_BYTES },
    Entry { name: "params", corpus: "params", read: params, repair_checksums: repair_zip, most_bytes: SMALL_BYTES },
    Entry { name: "pickle", corpus: "pickle", read: pickle, repair_checksums: repair_zip, most_bytes: SMALL_BYTES },
    Entry {
        name: "pickle_bytes",
        corpus: "pickle_bytes",
        read: pickle_bytes,
        repair_checksums: |_| None,
        most_bytes: PICKLE_BYTES,
    },
    Entry { name: "ply", corpus: "ply", read: ply, repair_checksums: |_| None, most_bytes: SMALL_BYTES },
    Entry {
        name: "ply_header",
        corpus: "ply_header",
        read: ply_header,
        repair_checksums: |_| None,
        most_bytes: SMALL_BYTES,
    },
    Entry { name: "recipe", corpus: "recipe", read: recipe, repair_checksums: |_| None, most_bytes: SMALL_BYTES },
    Entry {
        name: "recover",
        corpus: "container",
        read: recover,
        repair_checksums: repair_container,
        most_bytes: CONTAINER_BYTES,
    },
    Entry {
        name: "compressed_ply",
        corpus: "compressed_ply",
        read: |bytes, folder| still("a.compressed.ply", bytes, folder),
        repair_checksums: |_| None,
        most_bytes: SMALL_BYTES,
    },
    Entry {
        name: "glb",
        corpus: "glb",
        read: |bytes, folder| still("a.glb", bytes, folder),
        repair_checksums: |_| None,
        most_bytes: SMALL_BYTES,
    },
    Entry {
        name: "sog",
        corpus: "sog",
        read: |bytes, folder| still("a.sog", bytes, folder),
        repair_checksums: repair_zip,
        most_bytes: SMALL_BYTES,
    },
    Entry {
        name: "splat",
        corpus: "splat",
        read: |bytes, folder| still("a.splat", bytes, folder),
        repair_checksums: |_| None,
        most_bytes: SMALL_BYTES,
    },
    Entry {
        name: "spz",
        corpus: "spz",
        read: |bytes, folder| still("a.spz", bytes, folder),
        repair_checksums: |_| None,
        most_bytes: SMALL_BYTES,
    },
    Entry { name: "splatv", corpus: "splatv", read: splatv, repair_checksums: |_| None, most_bytes: SMALL_BYTES },
    Entry { name: "tsog", corpus: "tsog", read: tsog, repair_checksums: repair_zip, most_bytes: SMALL_BYTES },
    Entry { name: "stream", corpus: "stream", read: stream, repair_checksums: |_| None, most_bytes: SMALL_BYTES },
];

/// Temporary folder with small models in it. It lies in memory if the system allows this.
pub(crate) struct InputFolder(tempfile::TempDir);

/// Files of models with six Gaussians, given as (path, content). A fuzz target replaces one of the files.
const MODELS: [(&str, &[u8]); 8] = [
    ("of_config/cfg_args", include_bytes!("cfg_args/whole")),
    ("of_config/point_cloud/iteration_7/point_cloud.ply", include_bytes!("ply/whole")),
    ("of_config/point_cloud/iteration_7/deformation.pth", include_bytes!("pickle/whole")),
    ("of_field/cfg_args", include_bytes!("cfg_args/whole")),
    ("of_field/point_cloud/iteration_7/point_cloud.ply", include_bytes!("ply/whole")),
    // The tensors of a network tell which of two model formats it belongs to.
    ("of_network/cfg_args", b"Namespace(sh_degree=1, source_path='data')"),
    ("of_network/point_cloud/iteration_7/point_cloud.ply", include_bytes!("ply/whole")),
    ("of_splats/cfg_args", b"Namespace(source_path='data', prefilter_var=-1.0)"),
];

impl InputFolder {
    /// Creates the folder and its models.
    ///
    /// # Panics
    /// Panics if no folder can be created.
    pub(crate) fn new() -> InputFolder {
        let memory = Path::new("/dev/shm");
        let folder = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
        let folder = InputFolder(folder.expect("a folder for temporary files"));
        MODELS.iter().for_each(|(name, bytes)| drop(folder.write_file(name, bytes)));
        folder
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write_file(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.path(name);
        fs::create_dir_all(path.parent().expect("a folder of its own")).expect("a folder");
        fs::write(&path, bytes).expect("room for a small file");
        path
    }
}

/// Reads all attributes of every Gaussian in the first and the last frame.
fn read_first_and_last_frame(source: &dyn FrameSource) -> Outcome {
    let info = source.info();
    // A small file may declare any number of equal Gaussians; a run checks its memory limit before it reads them.
    if info.count > 10_000 {
        return Ok(());
    }
    let ids: Vec<u32> = (0..info.count as u32).collect();
    for frame in [0, info.times.len().saturating_sub(1)].into_iter().take(info.times.len()) {
        gather(source, &ids, frame, Attributes::all())?;
    }
    Ok(())
}

fn archive(bytes: &[u8], folder: &InputFolder) -> Outcome {
    let path = folder.path("a.gsz");
    let (content, _) = archive::decode(bytes, &path, ReadLimit::NONE)?;
    let to = folder.path("unpacked");
    let layout = restored_output_kind(&content, &path)?;
    if layout == Some(OutputKind::Model) {
        fs::create_dir(&to)?;
    }
    let unpacked = unpack(&content, &path, &to);
    if to.is_dir() {
        fs::remove_dir_all(to)?
    } else if to.exists() {
        fs::remove_file(to)?
    }
    unpacked?;
    // Models with a layout of their own have readers of their own.
    if layout.is_some() { model(&folder.write_file("a.gsz", bytes)) } else { Ok(()) }
}

/// Builds an archive from `bytes` and reads it. `bytes` holds the lengths of three sections (4 bytes each), then the
/// sections uncompressed: table, point cloud, field, and blobs as the rest. This function compresses the table and the
/// blobs, because most changes of compressed bytes would only make decompression fail.
fn archive_sections(bytes: &[u8], folder: &InputFolder) -> Outcome {
    let mut rest = bytes.get(12..).unwrap_or_default();
    let mut sections: [&[u8]; 4] = [&[]; 4];
    for (k, section) in sections[..3].iter_mut().enumerate() {
        let length = number::<4>(bytes, 4 * k).unwrap_or(0) as usize;
        (*section, rest) = rest.split_at(length.min(rest.len()));
    }
    sections[3] = rest;
    let packed = [0, 3].map(|k| zstd::bulk::compress(sections[k], 1));
    let [table, blobs] = packed;
    let (table, blobs) = (table?, blobs?);
    let mut file = archive::MAGIC.to_vec();
    file.extend(archive::VERSION.to_le_bytes());
    file.extend([0; 2]);
    let stored: [&[u8]; 4] = [&table, sections[1], sections[2], &blobs];
    for (stored, section) in stored.iter().zip(sections) {
        file.extend((stored.len() as u64).to_le_bytes());
        file.extend((section.len() as u64).to_le_bytes());
        file.extend(xxh3_64(stored).to_le_bytes());
    }
    file.extend(xxh3_64(&file).to_le_bytes());
    file.extend(stored.concat());
    archive(&file, folder)
}

fn cameras(bytes: &[u8], folder: &InputFolder) -> Outcome {
    // The format follows from the content; only poses have a file name of their own.
    let name = if bytes.first() == Some(&0x93) { "poses_bounds.npy" } else { "transforms.json" };
    cameras::load(&folder.write_file(name, bytes), &CameraOptions::default())?;
    Ok(())
}

/// Reads `bytes` as a pair of COLMAP files, once as binary and once as text files. `bytes` has the length of the file
/// `cameras` in 4 bytes, then the contents of the files `cameras` and `images`. Succeeds if one of the two readings
/// does.
fn colmap(bytes: &[u8], folder: &InputFolder) -> Outcome {
    let rest = bytes.get(4..).unwrap_or_default();
    let (cameras, images) = rest.split_at((number::<4>(bytes, 0).unwrap_or(0) as usize).min(rest.len()));
    let load = |kind: &str| {
        let sparse = format!("of_{kind}/sparse/0");
        folder.write_file(&format!("{sparse}/images.{kind}"), images);
        folder.write_file(&format!("{sparse}/cameras.{kind}"), cameras);
        cameras::load(&folder.path(&sparse), &CameraOptions::default()).map(drop)
    };
    let (binary, text) = (load("bin"), load("txt"));
    Ok(binary.or(text)?)
}

/// Opens a model of any format and reads its first and last frame. A model without times of its own gets two times.
fn model(path: &Path) -> Outcome {
    let mut model = models::open(path, &OpenOptions::default())?.into_linked()?;
    if model.source().info().times.is_empty() {
        model = model.with_times(vec![0.0, 0.5])?;
    }
    read_first_and_last_frame(model.source())
}

/// Reads the checkpoint `bytes` twice: as a single file, whose format is known from its content, and as a file of a
/// model folder. Succeeds if one of the two readings does.
fn checkpoint(bytes: &[u8], folder: &InputFolder) -> Outcome {
    let alone = model(&folder.write_file("a.pt", bytes));
    folder.write_file("of_splats/chkpnt7.pth", bytes);
    let inside = model(&folder.path("of_splats"));
    alone.or(inside)
}

fn cfg_args(bytes: &[u8], folder: &InputFolder) -> Outcome {
    folder.write_file("of_config/cfg_args", bytes);
    model(&folder.path("of_config"))
}

fn deform(bytes: &[u8], folder: &InputFolder) -> Outcome {
    folder.write_file("of_network/deform/iteration_7/deform.pth", bytes);
    model(&folder.path("of_network"))
}

fn params(bytes: &[u8], folder: &InputFolder) -> Outcome {
    model(&folder.write_file("params.npz", bytes))
}

fn splatv(bytes: &[u8], folder: &InputFolder) -> Outcome {
    model(&folder.write_file("a.splatv", bytes))
}

fn ftgs(bytes: &[u8], folder: &InputFolder) -> Outcome {
    model(&folder.write_file("a.ftgs.ply", bytes))
}

fn tsog(bytes: &[u8], folder: &InputFolder) -> Outcome {
    model(&folder.write_file("a.tsog", bytes))
}

/// Reads `bytes` as the file `name`, which has one frame, with a memory limit of 8 MiB. The limit is needed because a
/// small file may declare any number of Gaussians.
fn still(name: &str, bytes: &[u8], folder: &InputFolder) -> Outcome {
    let path = folder.write_file(name, bytes);
    let options = OpenOptions {
        memory: ReadLimit::new(8 << 20),
        scratch: Some(folder.0.path().to_owned()),
        ..OpenOptions::default()
    };
    read_first_and_last_frame(models::open(&path, &options)?.into_linked()?.source())
}

fn pickle(bytes: &[u8], folder: &InputFolder) -> Outcome {
    folder.write_file("of_field/point_cloud/iteration_7/deformation.pth", bytes);
    model(&folder.path("of_field"))
}

/// Reads a pickle that is not in a zip archive, with a memory limit of 1 MiB.
fn pickle_bytes(bytes: &[u8], _: &InputFolder) -> Outcome {
    parser_checks::check_pickle(bytes, 1 << 20).map(drop).ok_or_else(|| "no pickle".into())
}

fn container(bytes: &[u8], folder: &InputFolder) -> Outcome {
    let container = Container::open(&folder.write_file("a.gseq", bytes))?;
    read_first_and_last_frame(&container)?;
    container.reader().verify()?;
    Ok(())
}

fn recover(bytes: &[u8], folder: &InputFolder) -> Outcome {
    let to = folder.path("recovered.gseq");
    gseq::recover(folder.write_file("damaged.gseq", bytes), &to)?;
    // The recovered file is complete.
    gseq::Reader::open(&to)?.verify()?;
    Ok(())
}

fn ply(bytes: &[u8], folder: &InputFolder) -> Outcome {
    model(&folder.write_file("a.ply", bytes))
}

/// Reads `bytes` as the header of a PLY, in memory, without writing or opening a file.
fn ply_header(bytes: &[u8], _: &InputFolder) -> Outcome {
    check_header(bytes, Path::new("a.ply"))?;
    Ok(())
}

fn recipe(bytes: &[u8], _: &InputFolder) -> Outcome {
    let recipe = Recipe::from_toml(std::str::from_utf8(bytes)?, "default")?;
    Recipe::from_toml(&recipe.to_toml(), "paper")?;
    Ok(())
}

fn stream(bytes: &[u8], _: &InputFolder) -> Outcome {
    let mut stream = FrameStream::open(bytes, Path::new("standard input"), ReadLimit::NONE)?;
    let mut frame = Gaussians::zeros(0, stream.header().sh_degree);
    while stream.next_frame(&mut frame)?.is_some() {}
    Ok(())
}

fn number<const N: usize>(bytes: &[u8], at: usize) -> Option<u64> {
    let digits = bytes.get(at..at.checked_add(N)?)?;
    Some(digits.iter().rev().fold(0, |sum, &digit| sum << 8 | u64::from(digit)))
}

/// Computes the checksum of the bytes in `range` and writes it to the eight bytes from `at` on. Returns `None` if a
/// range is outside of `bytes`.
fn write_checksum(bytes: &mut [u8], range: std::ops::Range<usize>, at: usize) -> Option<()> {
    let checksum = xxh3_64(bytes.get(range)?);
    bytes.get_mut(at..at.checked_add(8)?)?.copy_from_slice(&checksum.to_le_bytes());
    Some(())
}

/// Returns the zip archive `bytes` with repaired checksums; `None` if they cannot be located. The directory of an
/// archive has the offset, length and checksum of each file, and each file has its checksum too.
fn repair_zip(bytes: &[u8]) -> Option<Vec<u8>> {
    let mut bytes = bytes.to_vec();
    let mut at = (0..bytes.len()).find(|&at| bytes[at..].starts_with(b"PK\x01\x02"))?;
    while bytes[at..].starts_with(b"PK\x01\x02") {
        let lengths = [28, 30, 32].map(|place| number::<2>(&bytes, at + place));
        let next = lengths.into_iter().try_fold(at + 46, |next, length| Some(next + length? as usize))?;
        let [size, file] = [20, 42].map(|place| number::<4>(&bytes, at + place));
        let file = file? as usize;
        let start = file + 30 + number::<2>(&bytes, file + 26)? as usize + number::<2>(&bytes, file + 28)? as usize;
        // The checksum of a compressed file is that of its uncompressed content.
        if number::<2>(&bytes, at + 10)? == 0 && bytes.get(file..)?.starts_with(b"PK\x03\x04") {
            let mut sum = Crc::new();
            sum.update(bytes.get(start..start + size? as usize)?);
            for place in [at + 16, file + 14] {
                bytes.get_mut(place..place + 4)?.copy_from_slice(&sum.sum().to_le_bytes());
            }
        }
        at = next.min(bytes.len());
    }
    Some(bytes)
}

/// Returns the archive `bytes` (format/ARCHIVE.md) with repaired checksums; `None` if they cannot be located. An
/// archive has four sections after a header with their lengths and checksums.
fn repair_archive(bytes: &[u8]) -> Option<Vec<u8>> {
    let mut bytes = bytes.to_vec();
    let mut at = 116;
    for section in 0..4 {
        let place = 12 + 24 * section;
        let end = at + usize::try_from(number::<8>(&bytes, place)?).ok().filter(|&length| length < bytes.len())?;
        write_checksum(&mut bytes, at..end, place + 16)?;
        at = end;
    }
    write_checksum(&mut bytes, 0..108, 108)?;
    Some(bytes)
}

/// Returns the container `bytes` (format/SPEC.md) with repaired checksums; `None` if they cannot be located. A
/// container has a header, records at multiples of 64 bytes, an index with copies of the records, and a trailer.
fn repair_container(bytes: &[u8]) -> Option<Vec<u8>> {
    let mut bytes = bytes.to_vec();
    let header = usize::try_from(number::<4>(&bytes, 12)?).ok()?;
    write_checksum(&mut bytes, 0..header.checked_sub(8)?, header - 8)?;
    let end = bytes.len().checked_sub(32)?;
    let footer = usize::try_from(number::<8>(&bytes, end)?).ok();
    let records = (header.next_multiple_of(64)..end).step_by(64);
    for at in records.filter(|&at| Some(at) != footer) {
        repair_record(&mut bytes, at);
    }
    // The index follows the time stamps of eight bytes each.
    if let Some(at) = footer.filter(|&at| bytes.get(at..).is_some_and(|rest| rest.starts_with(b"FOOT"))) {
        let frames = number::<8>(&bytes, at + 8)?;
        let index =
            usize::try_from(frames).ok().filter(|&frames| frames < bytes.len()).map(|frames| at + 64 + 8 * frames)?;
        (index..end).step_by(64).for_each(|at| repair_record(&mut bytes, at));
        write_checksum(&mut bytes, 0..header, at + 24)?;
        write_checksum(&mut bytes, at + 64..end, at + 32);
        write_checksum(&mut bytes, at..at + 56, at + 56);
    }
    write_checksum(&mut bytes, end..end + 16, end + 16)?;
    Some(bytes)
}

fn repair_record(bytes: &mut [u8], at: usize) {
    let repair = |bytes: &mut [u8]| {
        let payload = match bytes.get(at..at + 4)? {
            b"TILE" => {
                let start = usize::try_from(number::<8>(bytes, at + 24)?).ok()?;
                start..start.checked_add(number::<4>(bytes, at + 40)? as usize)?
            }
            b"TIME" => at + 64..at + 64 + 8 * number::<4>(bytes, at + 20)? as usize,
            _ => return None,
        };
        // If the payload extends beyond the end, only the checksum of the record is repaired.
        write_checksum(bytes, payload, at + 32);
        write_checksum(bytes, at..at + 56, at + 56)
    };
    repair(bytes);
}
