//! Whatever reads bytes that people hand in, each as a function of such bytes: what the saved corpus (`tests/corpus`) and the
//! fuzz targets (`fuzz`) run.
//!
//! In: bytes. Out: whether they were read, or the message that refuses them. What has a checksum is read a second time with
//! its checksums put right, or nothing behind them would ever be reached.

use std::error::Error;
use std::fs;
use std::path::{Path, PathBuf};

use flate2::Crc;
use splatsieve::archive;
use splatsieve::files::cameras;
use splatsieve::files::cameras::CameraOptions;
use splatsieve::files::container::Container;
use splatsieve::files::frame_stream::FrameStream;
use splatsieve::files::in_memory;
use splatsieve::files::ply::check_header;
use splatsieve::limits::ReadLimit;
use splatsieve::model::{Attributes, Gaussians};
use splatsieve::models;
use splatsieve::models::OpenOptions;
use splatsieve::models::archive::unpack;
use splatsieve::passes::gather;
use splatsieve::recipe::Recipe;
use splatsieve::source::FrameSource;
use xxhash_rust::xxh3::xxh3_64;

use crate::memory;

/// Whether bytes were read, or why not.
pub(crate) type Outcome = Result<(), Box<dyn Error>>;

/// A way in.
pub(crate) struct Entry {
    /// Name of the target.
    pub(crate) name: &'static str,
    /// Its folder in the corpus.
    pub(crate) corpus: &'static str,
    /// Reads the bytes, in a folder that it may write to.
    pub(crate) read: fn(&[u8], &Place) -> Outcome,
    /// The bytes with every checksum put right, where they have some that can be found.
    pub(crate) mended: fn(&[u8]) -> Option<Vec<u8>>,
    /// Most bytes that may be allocated at a time beyond [`PER_BYTE`] for each byte read.
    pub(crate) most_bytes: usize,
}

impl Entry {
    /// Reads `bytes` as they are, and with their checksums put right.
    ///
    /// # Panics
    /// Where a promise is broken: more memory than the limit, a message in the terms of Rust. And where reading panics.
    pub(crate) fn check(&self, bytes: &[u8], place: &Place) {
        self.check_one(bytes, place);
        if let Some(mended) = (self.mended)(bytes).filter(|mended| mended != bytes) {
            self.check_one(&mended, place);
        }
    }

    fn check_one(&self, bytes: &[u8], place: &Place) {
        let (outcome, peak) = memory::peak(|| (self.read)(bytes, place));
        let most = self.most_bytes + PER_BYTE * bytes.len();
        assert!(peak <= most, "{} bytes took {peak} of memory: expected at most {most}", bytes.len());
        let message = outcome.err().map(|error| error.to_string()).unwrap_or_default();
        // A message may say what the file says.
        let own = |term: &str| !bytes.windows(term.len()).any(|part| part == term.as_bytes());
        let found = OF_RUST.iter().find(|term| message.contains(*term) && own(term));
        assert!(found.is_none(), "a message with {found:?} in it: {message}");
    }
}

/// What only Rust's own text has.
const OF_RUST: [&str; 11] =
    ["Some(", "None)", "Ok(", "Err(", "Error(", "Error {", "ErrorKind", "Custom {", "Id {", "Record {", "Stats {"];

/// Bytes that may be allocated for each byte read, beside what an entry states.
pub(crate) const PER_BYTE: usize = 512;

/// What most readers may allocate whatever they read.
const LITTLE: usize = 32 << 20;
/// JSON is read through a buffer, and one text of a megabyte is kept at a time.
const STREAMED: usize = 4 << 20;
/// Memory that the reader of pickles is given, and room for messages.
const PICKLE: usize = (1 << 20) + (64 << 10);
/// A tile may hold 256 MiB (format/SPEC.md), which are decoded beside what they are decoded from.
const TILES: usize = 640 << 20;
/// An archive may mean 64 MiB, and 512 bytes for each of its own (format/ARCHIVE.md).
const CONTENT: usize = 256 << 20;

/// Every way in.
pub(crate) const ENTRIES: [Entry; 18] = [
    Entry { name: "archive", corpus: "archive", read: archive, mended: mended_archive, most_bytes: CONTENT },
    Entry {
        name: "archive_sections",
        corpus: "archive_sections",
        read: archive_sections,
        mended: |_| None,
        most_bytes: CONTENT,
    },
    Entry { name: "cameras", corpus: "cameras", read: cameras, mended: |_| None, most_bytes: LITTLE },
    Entry { name: "cfg_args", corpus: "cfg_args", read: cfg_args, mended: |_| None, most_bytes: LITTLE },
    Entry { name: "checkpoint", corpus: "checkpoint", read: checkpoint, mended: mended_zip, most_bytes: LITTLE },
    Entry { name: "colmap", corpus: "colmap", read: colmap, mended: |_| None, most_bytes: LITTLE },
    Entry { name: "container", corpus: "container", read: container, mended: mended_container, most_bytes: TILES },
    Entry { name: "deform", corpus: "deform", read: deform, mended: mended_zip, most_bytes: LITTLE },
    Entry { name: "params", corpus: "params", read: params, mended: mended_zip, most_bytes: LITTLE },
    Entry { name: "pickle", corpus: "pickle", read: pickle, mended: mended_zip, most_bytes: LITTLE },
    Entry { name: "cameras_json", corpus: "cameras", read: cameras_json, mended: |_| None, most_bytes: STREAMED },
    Entry { name: "pickle_bytes", corpus: "pickle_bytes", read: pickle_bytes, mended: |_| None, most_bytes: PICKLE },
    Entry { name: "ply", corpus: "ply", read: ply, mended: |_| None, most_bytes: LITTLE },
    Entry { name: "ply_header", corpus: "ply_header", read: ply_header, mended: |_| None, most_bytes: LITTLE },
    Entry { name: "recipe", corpus: "recipe", read: recipe, mended: |_| None, most_bytes: LITTLE },
    Entry { name: "recover", corpus: "container", read: recover, mended: mended_container, most_bytes: TILES },
    Entry { name: "splatv", corpus: "splatv", read: splatv, mended: |_| None, most_bytes: LITTLE },
    Entry { name: "stream", corpus: "stream", read: stream, mended: |_| None, most_bytes: LITTLE },
];

/// A folder in memory, where there is one, with a small model in it.
pub(crate) struct Place(tempfile::TempDir);

/// The files of models of six Gaussians, of which a target replaces one.
const MODELS: [(&str, &[u8]); 8] = [
    ("of_config/cfg_args", include_bytes!("cfg_args/whole")),
    ("of_config/point_cloud/iteration_7/point_cloud.ply", include_bytes!("ply/whole")),
    ("of_config/point_cloud/iteration_7/deformation.pth", include_bytes!("pickle/whole")),
    ("of_field/cfg_args", include_bytes!("cfg_args/whole")),
    ("of_field/point_cloud/iteration_7/point_cloud.ply", include_bytes!("ply/whole")),
    // A network's tensors say which of two families it is of.
    ("of_network/cfg_args", b"Namespace(sh_degree=1, source_path='data')"),
    ("of_network/point_cloud/iteration_7/point_cloud.ply", include_bytes!("ply/whole")),
    ("of_splats/cfg_args", b"Namespace(source_path='data', prefilter_var=-1.0)"),
];

impl Place {
    /// A new one.
    ///
    /// # Panics
    /// Where no folder can be made.
    pub(crate) fn new() -> Place {
        let memory = Path::new("/dev/shm");
        let folder = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
        let place = Place(folder.expect("a folder for temporary files"));
        MODELS.iter().for_each(|(name, bytes)| drop(place.put(name, bytes)));
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn put(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.path(name);
        fs::create_dir_all(path.parent().expect("a folder of its own")).expect("a folder");
        fs::write(&path, bytes).expect("room for a small file");
        path
    }
}

/// First and last frame, all columns of every Gaussian.
fn look(source: &dyn FrameSource) -> Outcome {
    let info = source.info();
    // A small file may hold any number of Gaussians that are all alike; a run asks its budget before it reads them.
    if info.count > 10_000 {
        return Ok(());
    }
    let ids: Vec<u32> = (0..info.count as u32).collect();
    for frame in [0, info.times.len().saturating_sub(1)].into_iter().take(info.times.len()) {
        gather(source, &ids, frame, Attributes::all())?;
    }
    Ok(())
}

fn archive(bytes: &[u8], place: &Place) -> Outcome {
    let path = place.path("a.gsz");
    let (content, _) = archive::decode(bytes, &path, ReadLimit::NONE)?;
    let to = place.path("unpacked");
    let unpacked = unpack(&content, &path, &to);
    if to.is_dir() {
        fs::remove_dir_all(to)?
    } else if to.exists() {
        fs::remove_file(to)?
    }
    Ok(unpacked?)
}

/// The sections as they are before they are packed: lengths of three, then table, cloud, field and blobs. Few changes of a
/// packed table would come through.
fn archive_sections(bytes: &[u8], place: &Place) -> Outcome {
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
    file.extend([1, 0, 0, 0]);
    let stored: [&[u8]; 4] = [&table, sections[1], sections[2], &blobs];
    for (stored, section) in stored.iter().zip(sections) {
        file.extend((stored.len() as u64).to_le_bytes());
        file.extend((section.len() as u64).to_le_bytes());
        file.extend(xxh3_64(stored).to_le_bytes());
    }
    file.extend(xxh3_64(&file).to_le_bytes());
    file.extend(stored.concat());
    archive(&file, place)
}

fn cameras(bytes: &[u8], place: &Place) -> Outcome {
    // By their contents; only poses have a name of their own.
    let name = if bytes.first() == Some(&0x93) { "poses_bounds.npy" } else { "transforms.json" };
    cameras::load(&place.put(name, bytes), &CameraOptions::default())?;
    Ok(())
}

/// The length of `cameras`, then `cameras` and `images`: as both kinds of file.
fn colmap(bytes: &[u8], place: &Place) -> Outcome {
    let rest = bytes.get(4..).unwrap_or_default();
    let (cameras, images) = rest.split_at((number::<4>(bytes, 0).unwrap_or(0) as usize).min(rest.len()));
    let load = |kind: &str| {
        let folder = format!("of_{kind}/sparse/0");
        place.put(&format!("{folder}/images.{kind}"), images);
        place.put(&format!("{folder}/cameras.{kind}"), cameras);
        cameras::load(&place.path(&folder), &CameraOptions::default()).map(drop)
    };
    let (binary, text) = (load("bin"), load("txt"));
    Ok(binary.or(text)?)
}

/// A model of any family, at two times where its frames are still to be chosen.
fn model(path: &Path) -> Outcome {
    let mut model = models::open(path, &OpenOptions::default())?;
    if model.source().info().times.is_empty() {
        model = model.with_times(vec![0.0, 0.5])?;
    }
    look(model.source())
}

/// As a file, by which it is told what it is of, and as that of a model's folder.
fn checkpoint(bytes: &[u8], place: &Place) -> Outcome {
    let alone = model(&place.put("a.pt", bytes));
    place.put("of_splats/chkpnt7.pth", bytes);
    let inside = model(&place.path("of_splats"));
    alone.or(inside)
}

fn cfg_args(bytes: &[u8], place: &Place) -> Outcome {
    place.put("of_config/cfg_args", bytes);
    model(&place.path("of_config"))
}

fn deform(bytes: &[u8], place: &Place) -> Outcome {
    place.put("of_network/deform/iteration_7/deform.pth", bytes);
    model(&place.path("of_network"))
}

fn params(bytes: &[u8], place: &Place) -> Outcome {
    model(&place.put("params.npz", bytes))
}

fn splatv(bytes: &[u8], place: &Place) -> Outcome {
    model(&place.put("a.splatv", bytes))
}

fn pickle(bytes: &[u8], place: &Place) -> Outcome {
    place.put("of_field/point_cloud/iteration_7/deformation.pth", bytes);
    model(&place.path("of_field"))
}

/// A pickle alone, within one MiB of memory.
fn pickle_bytes(bytes: &[u8], _: &Place) -> Outcome {
    in_memory::pickle(bytes, 1 << 20).map(drop).ok_or_else(|| "no pickle".into())
}

/// The stream by which camera files are read.
fn cameras_json(bytes: &[u8], _: &Place) -> Outcome {
    in_memory::cameras_json(bytes)?;
    Ok(())
}

fn container(bytes: &[u8], place: &Place) -> Outcome {
    let container = Container::open(&place.put("a.gseq", bytes))?;
    look(&container)?;
    container.reader().verify()?;
    Ok(())
}

fn recover(bytes: &[u8], place: &Place) -> Outcome {
    let to = place.path("recovered.gseq");
    gseq::recover(place.put("damaged.gseq", bytes), &to)?;
    // What was saved is whole.
    gseq::Reader::open(&to)?.verify()?;
    Ok(())
}

fn ply(bytes: &[u8], place: &Place) -> Outcome {
    model(&place.put("a.ply", bytes))
}

/// Headers alone, in memory: no file is written or opened.
fn ply_header(bytes: &[u8], _: &Place) -> Outcome {
    check_header(bytes, Path::new("a.ply"))?;
    Ok(())
}

fn recipe(bytes: &[u8], _: &Place) -> Outcome {
    let recipe = Recipe::from_toml(std::str::from_utf8(bytes)?, "default")?;
    Recipe::from_toml(&recipe.to_toml(), "paper")?;
    Ok(())
}

fn stream(bytes: &[u8], _: &Place) -> Outcome {
    let mut stream = FrameStream::open(bytes, Path::new("standard input"), ReadLimit::NONE)?;
    let mut frame = Gaussians::zeros(0, stream.header().sh_degree);
    while stream.next_frame(&mut frame)?.is_some() {}
    Ok(())
}

fn number<const N: usize>(bytes: &[u8], at: usize) -> Option<u64> {
    let digits = bytes.get(at..at.checked_add(N)?)?;
    Some(digits.iter().rev().fold(0, |sum, &digit| sum << 8 | u64::from(digit)))
}

/// Writes the checksum of `of` to the eight bytes from `at` on.
fn sum(bytes: &mut [u8], of: std::ops::Range<usize>, at: usize) -> Option<()> {
    let checksum = xxh3_64(bytes.get(of)?);
    bytes.get_mut(at..at.checked_add(8)?)?.copy_from_slice(&checksum.to_le_bytes());
    Some(())
}

/// A zip archive: its directory says where each file begins and how long it is, and has its checksum, as the file has.
fn mended_zip(bytes: &[u8]) -> Option<Vec<u8>> {
    let mut bytes = bytes.to_vec();
    let mut at = (0..bytes.len()).find(|&at| bytes[at..].starts_with(b"PK\x01\x02"))?;
    while bytes[at..].starts_with(b"PK\x01\x02") {
        let lengths = [28, 30, 32].map(|place| number::<2>(&bytes, at + place));
        let next = lengths.into_iter().try_fold(at + 46, |next, length| Some(next + length? as usize))?;
        let [size, file] = [20, 42].map(|place| number::<4>(&bytes, at + place));
        let file = file? as usize;
        let start = file + 30 + number::<2>(&bytes, file + 26)? as usize + number::<2>(&bytes, file + 28)? as usize;
        // Of a compressed one the checksum is that of what it unpacks to.
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

/// format/ARCHIVE.md: four sections behind a head that has their lengths and checksums.
fn mended_archive(bytes: &[u8]) -> Option<Vec<u8>> {
    let mut bytes = bytes.to_vec();
    let mut at = 116;
    for section in 0..4 {
        let place = 12 + 24 * section;
        let end = at + usize::try_from(number::<8>(&bytes, place)?).ok().filter(|&length| length < bytes.len())?;
        sum(&mut bytes, at..end, place + 16)?;
        at = end;
    }
    sum(&mut bytes, 0..108, 108)?;
    Some(bytes)
}

/// format/SPEC.md: a header, records at multiples of 64 bytes, an index of copies of them, a trailer.
fn mended_container(bytes: &[u8]) -> Option<Vec<u8>> {
    let mut bytes = bytes.to_vec();
    let header = usize::try_from(number::<4>(&bytes, 12)?).ok()?;
    sum(&mut bytes, 0..header.checked_sub(8)?, header - 8)?;
    let end = bytes.len().checked_sub(32)?;
    let footer = usize::try_from(number::<8>(&bytes, end)?).ok();
    let records = (header.next_multiple_of(64)..end).step_by(64);
    for at in records.filter(|&at| Some(at) != footer) {
        mend_record(&mut bytes, at);
    }
    // The index lies behind the time stamps, which are any number of eight bytes.
    if let Some(at) = footer.filter(|&at| bytes.get(at..).is_some_and(|rest| rest.starts_with(b"FOOT"))) {
        let frames = number::<8>(&bytes, at + 8)?;
        let index =
            usize::try_from(frames).ok().filter(|&frames| frames < bytes.len()).map(|frames| at + 64 + 8 * frames)?;
        (index..end).step_by(64).for_each(|at| mend_record(&mut bytes, at));
        sum(&mut bytes, 0..header, at + 24)?;
        sum(&mut bytes, at + 64..end, at + 32);
        sum(&mut bytes, at..at + 56, at + 56);
    }
    sum(&mut bytes, end..end + 16, end + 16)?;
    Some(bytes)
}

fn mend_record(bytes: &mut [u8], at: usize) {
    let mend = |bytes: &mut [u8]| {
        let payload = match bytes.get(at..at + 4)? {
            b"TILE" => {
                let start = usize::try_from(number::<8>(bytes, at + 24)?).ok()?;
                start..start.checked_add(number::<4>(bytes, at + 40)? as usize)?
            }
            b"TIME" => at + 64..at + 64 + 8 * number::<4>(bytes, at + 20)? as usize,
            _ => return None,
        };
        // Of a payload beyond the end the record alone is put right.
        sum(bytes, payload, at + 32);
        sum(bytes, at..at + 56, at + 56)
    };
    mend(bytes);
}
