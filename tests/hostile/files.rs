//! Tests of binary inputs that announce more content than they have: PLY files, frame streams, containers, archives and
//! arrays. Other tests give devices and other special files in place of regular files.
//!
//! Large inputs are sparse files: they take no space on disk and no memory of the test process.

use std::fs::{self, File};
use std::io::{self, BufWriter, Read, Write};
use std::os::unix::fs::symlink;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use xxhash_rust::xxh3::xxh3_64;
use zip::write::FileOptions;
use zip::{CompressionMethod, ZipWriter};

use crate::runner::{Folder, MIB, Outcome, Random, SMALL_MEMORY, is_optimized, seed};

/// Names of the properties of a PLY of SH degree 0.
const NAMES: &str = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
/// Number of bytes of a PLY row with the properties [`NAMES`].
const ROW: u64 = 14 * 4;

/// Writes a file with `head` and then zeros up to `len` bytes; the zeros take no space on disk.
fn sparse(folder: &Folder, name: &str, head: impl AsRef<[u8]>, len: u64) -> PathBuf {
    let path = folder.write(name, head);
    File::options().write(true).open(&path).unwrap().set_len(len).unwrap();
    path
}

/// Returns the header of a PLY of `count` Gaussians in the encoding `format`, with `extra` additional properties.
fn ply_header(format: &str, count: u64, extra: usize) -> String {
    let mut header = format!("ply\nformat {format} 1.0\nelement vertex {count}\n");
    NAMES.split(' ').for_each(|name| header += &format!("property float {name}\n"));
    (0..extra).for_each(|k| header += &format!("property float extra_{k}\n"));
    header + "end_header\n"
}

/// Returns row `i` of a PLY with `extra` additional properties.
fn ply_row(i: usize, extra: usize) -> Vec<u8> {
    let values = [(i % 31) as f32, (i % 17) as f32, (i % 7) as f32, 0.5, 0.5, 0.5, 2.0, -3.0, -3.0, -3.0, 1.0];
    let mut row: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    row.resize(ROW as usize + 4 * extra, 0);
    row
}

/// Runs the program with a memory limit of 64 MiB and checks that it keeps the limit.
fn small(folder: &Folder, arguments: &str) -> Outcome {
    let (memory, bytes) = SMALL_MEMORY;
    folder.attack(&format!("{arguments} --memory {memory}")).run().within(bytes)
}

#[test]
fn ply_with_900_further_properties_keeps_within_memory() {
    let folder = Folder::new();
    let (count, extra) = (20_000, 900);
    let mut out = BufWriter::new(File::create(folder.path("wide.ply")).unwrap());
    out.write_all(ply_header("binary_little_endian", count, extra).as_bytes()).unwrap();
    (0..count as usize).for_each(|i| out.write_all(&ply_row(i, extra)).unwrap());
    drop(out);
    small(&folder, "convert wide.ply wide.gseq").succeeded();
    small(&folder, "convert wide.ply copy.ply").succeeded();
    assert_eq!(
        fs::metadata(folder.path("copy.ply")).unwrap().len(),
        fs::metadata(folder.path("wide.ply")).unwrap().len()
    );
}

#[test]
fn ply_with_a_tail_of_300_mb_keeps_within_memory() {
    let folder = Folder::new();
    let header = ply_header("binary_little_endian", 10, 0);
    let mut head = header.into_bytes();
    (0..10).for_each(|i| head.extend(ply_row(i, 0)));
    let len = head.len() as u64 + 300 * MIB;
    sparse(&folder, "tail.ply", head, len);
    small(&folder, "info tail.ply").succeeded();
    small(&folder, "convert tail.ply tail.gseq").succeeded();
    small(&folder, "convert tail.ply copy.ply").succeeded();
    assert_eq!(fs::metadata(folder.path("copy.ply")).unwrap().len(), len);
}

#[test]
fn archive_of_a_ply_with_a_large_tail_names_the_limit() {
    let folder = Folder::new();
    let mut head = ply_header("binary_little_endian", 10, 0).into_bytes();
    (0..10).for_each(|i| head.extend(ply_row(i, 0)));
    sparse(&folder, "tail.ply", head, 300 * MIB);
    let outcome = folder.attack("compress tail.ply -o small.gsz --no-refine --memory 100MiB").run();
    outcome.within(100 * MIB).refused(1, &["tail.ply", "beside the attributes", "--memory"]);
    assert!(!folder.path("small.gsz").exists());
}

#[test]
fn malicious_ply_headers_are_refused_in_little_memory() {
    let folder = Folder::new();
    let whole = ply_header("binary_little_endian", 10, 0);
    let more = |count: usize, line: &str| {
        let lines: String = (0..count).map(|k| line.replace('#', &k.to_string())).collect();
        whole.replace("element vertex", &format!("{lines}element vertex"))
    };
    let bombs = [
        ("properties", ply_header("binary_little_endian", 10, 100_000), 1, "end_header line within"),
        ("properties_that_fit", ply_header("binary_little_endian", 10, 35_000), 1, "rows × "),
        ("comments", more(200_000, "comment #\n"), 1, "end_header line within"),
        ("comments_that_fit", more(60_000, "comment #\n"), 1, "10 rows × 56 bytes"),
        ("elements", more(60_000, "element e# 0\n"), 1, "rows × "),
        ("count", whole.replace("vertex 10", &format!("vertex {}", 1u64 << 60)), 1, "at most 4294967295 rows"),
        ("product", more(1, "element e 4611686018427387904\nproperty double x\n"), 1, "far too many"),
        (
            "text_count",
            whole.replace("binary_little_endian", "ascii").replace("vertex 10", "vertex 4000000000"),
            1,
            "bytes of text",
        ),
        ("lists", more(1, "element face 3\nproperty list uchar int vertex_indices\n"), 1, "list property"),
    ];
    for (name, header, code, says) in bombs {
        folder.write(&format!("{name}.ply"), header);
        small(&folder, &format!("info {name}.ply")).refused(code, &[&format!("{name}.ply"), says]);
    }
}

#[test]
fn ply_of_a_gigabyte_without_a_line_end_is_refused() {
    let folder = Folder::new();
    sparse(&folder, "comment.ply", "ply\nformat ascii 1.0\ncomment ", 1 << 30);
    small(&folder, "info comment.ply").refused(1, &["comment.ply, header", "end_header line within"]);
    sparse(&folder, "zeros.ply", "", 1 << 30);
    small(&folder, "info zeros.ply").refused(1, &["zeros.ply, first line"]);
    sparse(&folder, "token.ply", ply_header("ascii", 3, 0) + "1", 1 << 30);
    small(&folder, "info token.ply").refused(1, &["token.ply, line 19", "a row of 14 numbers", "a line of more than"]);
}

#[test]
fn text_ply_is_parsed_once_for_any_number_of_blocks() {
    let folder = Folder::new();
    let rows = if is_optimized() { 200_000 } else { 30_000 };
    text_ply(&folder, "text.ply", rows);
    // Reading it once more for each block of 1024 rows took 31 s for 100,000 rows.
    let outcome = small(&folder, "convert text.ply text.gseq").succeeded();
    assert!(outcome.seconds < 10.0, "{} s", outcome.seconds);
}

/// Writes a text PLY of SH degree 0 with `rows` Gaussians.
fn text_ply(folder: &Folder, name: &str, rows: u64) {
    let mut out = BufWriter::new(File::create(folder.path(name)).unwrap());
    out.write_all(ply_header("ascii", rows, 0).as_bytes()).unwrap();
    for i in 0..rows {
        writeln!(out, "{} {} {} .5 .5 .5 2 -3 -3 -3 1 0 0 0", i % 31, i % 17, i % 7).unwrap();
    }
}

/// Returns the header of a frame stream (format/STREAM.md) of the version `version` with `gaussians` Gaussians. The
/// bits of `columns` are the attributes that vary with time.
fn stream_header(version: u32, gaussians: u64, columns: u32) -> Vec<u8> {
    let mut out = b"\x89GSTR\r\n\x1a".to_vec();
    out.extend([version, 0].map(u32::to_le_bytes).concat());
    out.extend(gaussians.to_le_bytes());
    out.extend([columns, 0].map(u32::to_le_bytes).concat());
    out
}

/// Returns the mark that precedes a frame of `bytes` bytes in a stream.
fn stream_frame(bytes: u64) -> Vec<u8> {
    [&b"FRAM"[..], &0u32.to_le_bytes(), &0f64.to_le_bytes(), &bytes.to_le_bytes()].concat()
}

/// Runs the program with the file `stdin` as standard input and a memory limit of 64 MiB, and checks that it keeps the
/// limit.
fn small_with_stdin(folder: &Folder, arguments: &str, stdin: &Path) -> Outcome {
    let (memory, bytes) = SMALL_MEMORY;
    let attack = folder.attack(&format!("{arguments} --memory {memory}"));
    attack.stdin(File::open(stdin).unwrap()).run().within(bytes)
}

#[test]
fn stream_with_an_endless_frame_is_refused_before_it_arrives() {
    let folder = Folder::new();
    // 2^32 − 1 Gaussians of 14 values each.
    let endless = u64::from(u32::MAX) * ROW;
    let stream = [stream_header(2, 0, 31), stream_frame(endless)].concat();
    let path = sparse(&folder, "endless", stream, 1 << 34);
    for verb in ["info -", "convert - a.gseq"] {
        small_with_stdin(&folder, verb, &path)
            .refused(1, &["standard input, frame 0, byte 48", "one frame", "--memory"]);
    }
    assert!(!folder.path("a.gseq").exists());
}

#[test]
fn stream_with_constant_rows_beyond_memory_is_refused() {
    let folder = Folder::new();
    // 2^24 Gaussians of which only positions vary.
    let path = sparse(&folder, "constant", stream_header(1, 1 << 24, 1), 1 << 30);
    small_with_stdin(&folder, "info -", &path).refused(1, &["standard input, byte 16", "constant columns", "--memory"]);
    let path = sparse(&folder, "more", stream_header(1, u64::from(u32::MAX), 1), 1 << 30);
    small_with_stdin(&folder, "info -", &path).refused(1, &["standard input, byte 16", "constant columns"]);
}

/// Returns an archive (format/ARCHIVE.md) with the sections `stored`, whose header declares the lengths `content` of
/// their decompressed contents.
fn archive(stored: [&[u8]; 4], content: [u64; 4]) -> Vec<u8> {
    let mut out = b"\x89GSZ\r\n\x1a\n\x02\0\0\0".to_vec();
    for (bytes, length) in stored.iter().zip(content) {
        out.extend([bytes.len() as u64, length, xxh3_64(bytes)].map(u64::to_le_bytes).concat());
    }
    out.extend(xxh3_64(&out).to_le_bytes());
    stored.iter().for_each(|bytes| out.extend_from_slice(bytes));
    out
}

/// Returns `count` zero bytes, compressed as a zstd frame.
fn packed_zeros(count: u64) -> Vec<u8> {
    let mut encoder = zstd::stream::Encoder::new(Vec::new(), 1).unwrap();
    io::copy(&mut io::repeat(0).take(count), &mut encoder).unwrap();
    encoder.finish().unwrap()
}

#[test]
fn archives_that_decompress_to_gigabytes_are_refused() {
    let folder = Folder::new();
    let table = zstd::bulk::compress(b"{}", 1).unwrap();
    let blobs = packed_zeros(1 << 30);
    let bombs = [
        ("blobs", archive([&table, &[], &[], &blobs], [2, 0, 0, 1 << 30]), "bytes of content in"),
        ("table", archive([&blobs, &[], &[], &table], [1 << 26, 0, 0, 2]), "at most 1048576 bytes of content"),
        ("a_lie", archive([&table, &[], &[], &blobs], [2, 0, 0, 1000]), "1000 bytes of content"),
        ("a_small_lie", archive([&blobs, &[], &[], &table], [1000, 0, 0, 2]), "1000 bytes of content"),
    ];
    for (name, bytes, says) in bombs {
        folder.write(&format!("{name}.gsz"), bytes);
        // The limit does not depend on `--memory`.
        let arguments = [format!("info {name}.gsz"), format!("convert {name}.gsz out")];
        for arguments in arguments {
            let outcome = folder.attack(&arguments).run().refused(1, &[&format!("{name}.gsz"), says]);
            outcome.within(SMALL_MEMORY.1);
        }
    }
    folder.write("limit.gsz", archive([&table, &[], &[], &packed_zeros(60 * MIB)], [2, 0, 0, 60 * MIB]));
    small(&folder, "info limit.gsz").refused(1, &["limit.gsz, head", "the archive and its content", "--memory"]);
}

#[test]
fn sparse_archives_are_refused_by_their_header() {
    let folder = Folder::new();
    sparse(&folder, "zeros.gsz", "", 3 << 30);
    folder.attack("info zeros.gsz").run().refused(1, &["zeros.gsz, byte 0"]).within(SMALL_MEMORY.1);
    let table = zstd::bulk::compress(b"{}", 1).unwrap();
    let mut head = archive([&table, &[], &[], &[]], [2, 0, 0, 1]);
    let len = 3u64 << 30;
    let blobs = len - head.len() as u64;
    head[84..92].copy_from_slice(&blobs.to_le_bytes());
    let sum = xxh3_64(&head[..108]).to_le_bytes();
    head[108..116].copy_from_slice(&sum);
    sparse(&folder, "blobs.gsz", &head, len);
    small(&folder, "info blobs.gsz").refused(1, &["blobs.gsz, head", "--memory"]);
    sparse(&folder, "longer.gsz", &head, len + 1);
    small(&folder, "info longer.gsz").refused(1, &["longer.gsz, end", "nothing after the last section"]);
}

/// Adds a NumPy array of zeros to a zip archive.
fn zeros(archive: &mut ZipWriter<File>, name: &str, shape: &[u64]) {
    array(archive, name, shape, &mut io::repeat(0));
}

/// Adds a NumPy array of f32 with the content `bytes` to a zip archive.
fn array(archive: &mut ZipWriter<File>, name: &str, shape: &[u64], bytes: &mut dyn Read) {
    let options = FileOptions::default().compression_method(CompressionMethod::Deflated);
    archive.start_file(format!("{name}.npy"), options).unwrap();
    let lengths: Vec<String> = shape.iter().map(u64::to_string).collect();
    let mut text = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({},), }}", lengths.join(", "));
    text += &" ".repeat(64 - (text.len() + 11) % 64);
    text.push('\n');
    archive.write_all(b"\x93NUMPY\x01\0").unwrap();
    archive.write_all(&(text.len() as u16).to_le_bytes()).unwrap();
    archive.write_all(text.as_bytes()).unwrap();
    io::copy(&mut bytes.take(4 * shape.iter().product::<u64>()), archive).unwrap();
}

#[test]
fn arrays_are_compared_before_any_is_unpacked() {
    let folder = Folder::new();
    let mut archive = ZipWriter::new(File::create(folder.path("params.npz")).unwrap());
    let mut random = Random::new(seed(14));
    let noise: Vec<u8> = (0..1500).flat_map(|_| random.bits().to_le_bytes()).collect();
    array(&mut archive, "seg_colors", &[1000, 3], &mut &noise[..]);
    zeros(&mut archive, "means3D", &[10, 1000, 3]);
    zeros(&mut archive, "unnorm_rotations", &[10, 1000, 4]);
    zeros(&mut archive, "rgb_colors", &[10, 1000, 3]);
    zeros(&mut archive, "log_scales", &[1000, 3]);
    zeros(&mut archive, "logit_opacities", &[999, 1]);
    archive.finish().unwrap();
    // Unpacking the first array would find this damage.
    let path = folder.path("params.npz");
    let mut bytes = fs::read(&path).unwrap();
    bytes[6000..6020].fill(0xff);
    fs::write(&path, bytes).unwrap();
    small(&folder, "info params.npz").refused(1, &["params.npz, logit_opacities", "[1000, 1]", "[999, 1]"]);
}

#[test]
fn arrays_that_unpack_to_far_more_than_their_file_are_refused() {
    let folder = Folder::new();
    let mut archive = ZipWriter::new(File::create(folder.path("params.npz")).unwrap());
    for (name, width) in [("means3D", 3), ("unnorm_rotations", 4), ("rgb_colors", 3)] {
        zeros(&mut archive, name, &[100, 30_000, width]);
    }
    zeros(&mut archive, "log_scales", &[30_000, 3]);
    zeros(&mut archive, "logit_opacities", &[30_000, 1]);
    archive.finish().unwrap();
    let outcome = small(&folder, "info params.npz");
    outcome.refused(1, &["params.npz, unnorm_rotations", "arrays of at most", "numpy.savez"]);
}

#[test]
fn zip_directories_with_too_many_files_are_refused() {
    let folder = Folder::new();
    let end = |files: u16, list: u32| {
        let mut end = b"PK\x05\x06\0\0\0\0".to_vec();
        end.extend([files.to_le_bytes(), files.to_le_bytes()].concat());
        end.extend([list.to_le_bytes(), 0u32.to_le_bytes()].concat());
        end.extend([0, 0]);
        end
    };
    for (name, files, list, says) in [
        ("files", 60_000, 0, "60000 files"),
        ("most", u16::MAX, 0, "65535 files"),
        ("list", 1, 1 << 30, "in a list of"),
    ] {
        let path = sparse(&folder, &format!("{name}.npz"), "PK", 1 << 30);
        File::options().append(true).open(path).unwrap().write_all(&end(files, list)).unwrap();
        small(&folder, &format!("info {name}.npz")).refused(1, &[&format!("{name}.npz, list of arrays"), says]);
    }
}

#[test]
fn splatv_of_100_mib_of_zeros_keeps_within_memory() {
    let folder = Folder::new();
    let size = 4096u64 * 1_600 * 16;
    let text = format!("[{{\"type\":\"splat\",\"size\":{size},\"texwidth\":4096,\"texheight\":1600,\"cameras\":[]}}]");
    let head = [&0x674bu32.to_le_bytes()[..], &(text.len() as u32).to_le_bytes(), text.as_bytes()].concat();
    let len = head.len() as u64 + size;
    let path = sparse(&folder, "zeros.splatv", &head, len);
    small(&folder, "info zeros.splatv").ended();
    // With a last byte that is not zero every row before it is a Gaussian.
    File::options().write(true).open(&path).unwrap().set_len(len - 1).unwrap();
    File::options().append(true).open(&path).unwrap().write_all(&[1]).unwrap();
    small(&folder, "info zeros.splatv").refused(1, &["zeros.splatv, its texture", "--memory"]);
    let text = [&0x674bu32.to_le_bytes()[..], &(1u32 << 30).to_le_bytes(), b"["].concat();
    sparse(&folder, "text.splatv", text, (1 << 30) + 100);
    small(&folder, "info text.splatv").refused(1, &["text.splatv, byte 4", "a text of at most"]);
}

#[test]
fn container_declaring_2_to_the_27_frames_is_refused() {
    let folder = Folder::new();
    let path = folder.path("bomb.gseq");
    let columns = [("position", 3), ("rotation", 4), ("log_scale", 3), ("opacity_logit", 1), ("sh", 3)];
    let columns = columns.map(|(name, width)| gseq::ColumnSpec { name: name.into(), width, max_error: 0.0 }).into();
    let layout =
        gseq::Layout { gaussians: 0, gaussian_block: 1, frame_block: 1, columns, attributes: Default::default() };
    gseq::Writer::create(&path, layout).unwrap().finish().unwrap();
    let mut bytes = fs::read(&path).unwrap();
    let trailer = bytes.split_off(bytes.len() - 32);
    let footer = u64::from_le_bytes(trailer[..8].try_into().unwrap()) as usize;
    bytes.truncate(footer + 64);
    bytes[footer + 8..footer + 16].copy_from_slice(&(1u64 << 27).to_le_bytes());
    let sum = xxh3_64(&bytes[footer..footer + 56]).to_le_bytes();
    bytes[footer + 56..footer + 64].copy_from_slice(&sum);
    let len = bytes.len() as u64 + (8 << 27);
    let path = sparse(&folder, "bomb.gseq", bytes, len);
    File::options().append(true).open(path).unwrap().write_all(&trailer).unwrap();
    small(&folder, "info bomb.gseq").refused(1, &["bomb.gseq", "an index that takes at most", "--memory"]);
}

#[test]
fn files_of_other_kinds_are_refused_by_name_without_waiting() {
    let folder = Folder::new();
    for extension in ["ply", "gsz", "gseq", "npz", "splatv", "pth", "pt"] {
        let pipe = folder.path(&format!("pipe.{extension}"));
        let name = std::ffi::CString::new(pipe.as_os_str().as_encoded_bytes()).unwrap();
        // SAFETY: the name ends with a zero byte.
        assert_eq!(unsafe { libc::mkfifo(name.as_ptr(), 0o600) }, 0);
        symlink("/dev/zero", folder.path(&format!("zero.{extension}"))).unwrap();
        let _socket = UnixListener::bind(folder.path(&format!("socket.{extension}"))).unwrap();
        for (kind, found) in [("pipe", "a named pipe"), ("zero", "a device"), ("socket", "a socket")] {
            let name = format!("{kind}.{extension}");
            small(&folder, &format!("info {name}")).refused(1, &[&name, found, "standard input, given as -"]);
        }
    }
    for verb in ["info pipe.gseq --check", "info pipe.gseq --repair out.gseq"] {
        folder.attack(verb).run().refused(1, &["pipe.gseq", "regular file"]).within(SMALL_MEMORY.1);
    }
    folder.attack("convert zero.gsz out").run().refused(1, &["zero.gsz", "a device"]).within(SMALL_MEMORY.1);
    assert!(!folder.path("out.gseq").exists() && !folder.path("out").exists());
}

#[test]
fn pipe_as_a_frame_or_an_image_is_not_waited_for() {
    let folder = Folder::new();
    let pipe = |name: &str| {
        let path = folder.path(name);
        let name = std::ffi::CString::new(path.as_os_str().as_encoded_bytes()).unwrap();
        // SAFETY: the name ends with a zero byte.
        assert_eq!(unsafe { libc::mkfifo(name.as_ptr(), 0o600) }, 0);
    };
    let mut whole = ply_header("binary_little_endian", 1, 0).into_bytes();
    whole.extend(ply_row(0, 0));
    folder.write("frames/f_0.ply", whole);
    pipe("frames/f_1.ply");
    small(&folder, "info frames").refused(1, &["f_1.ply"]);
    pipe("r_0.png");
    let pose = "[[1,0,0,0],[0,1,0,0],[0,0,1,4],[0,0,0,1]]";
    let frames =
        format!("{{\"camera_angle_x\": 0.7, \"frames\": [{{\"file_path\": \"r_0\", \"transform_matrix\": {pose}}}]}}");
    folder.write("transforms.json", frames);
    let outcome =
        folder.attack("render {tiny} --frames 2 --frame 0 --view 0 --cameras transforms.json -o out.png").run();
    outcome.refused(1, &["transforms.json", "--resolution"]);
}

#[test]
fn input_cut_short_while_read_is_an_error_that_names_it() {
    cut_while_read(if is_optimized() { 24 } else { 6 });
}

#[test]
#[ignore = "slow: 200 runs, a few seconds with the release program"]
fn slow_input_cut_short_at_200_moments_is_an_error() {
    cut_while_read(200);
}

/// Converts a PLY to a container `runs` times. Each time, the PLY is cut short at another moment while it is read.
fn cut_while_read(runs: u64) {
    let folder = Folder::new();
    let (extra, rows) = (200, 30_000);
    let header = ply_header("binary_little_endian", rows, extra);
    let len = header.len() as u64 + rows * (ROW + 4 * extra as u64);
    for run in 0..runs {
        let path = sparse(&folder, "cut.ply", &header, len);
        let running = folder.attack("convert cut.ply cut.gseq --overwrite").start();
        thread::sleep(Duration::from_millis(if is_optimized() { 2 + run } else { 40 + 60 * run }));
        File::options().write(true).open(&path).unwrap().set_len(header.len() as u64 + 10).unwrap();
        let outcome = running.wait().ended();
        match outcome.code {
            Some(0) => {}
            _ => drop(outcome.refused(1, &["cut.ply"])),
        }
    }
}
