use super::*;
use crate::diagnostics::demo_scene::DemoScene;
use crate::outputs::frame_stream::StreamWriter;
use crate::source::{FrameSource, Ids};

const N: usize = 150;
const T: usize = 4;

/// Returns a small scene, the bytes of its frame stream, and the offsets of all marks (fixed-size parts): one before
/// each frame, and the end mark.
fn written() -> (DemoScene, Vec<u8>, Vec<usize>) {
    let scene = DemoScene::new(N, T);
    let info = scene.info();
    let header = StreamHeader { count: N, sh_degree: info.sh_degree, varying: info.varying, is_unlinked: false };
    let states = states(&scene);
    let mut bytes = Vec::new();
    let mut stream = StreamWriter::new(&mut bytes, Path::new("test"), header, &states[0]).unwrap();
    for (&time, state) in info.times.iter().zip(&states) {
        stream.write_frame(time, state).unwrap();
    }
    stream.finish().unwrap();
    let frame = FrameMark::BYTES + header.frame_bytes() as usize;
    let first = bytes.len() - FrameMark::BYTES - T * frame;
    (scene, bytes, (0..=T).map(|t| first + t * frame).collect())
}

/// Returns the attributes of all Gaussians of the scene at each frame.
fn states(scene: &DemoScene) -> Vec<Gaussians> {
    let mut reader = scene.open(Ids::Range(0..N)).unwrap();
    (0..T)
        .map(|t| {
            let mut state = Gaussians::zeros(N, scene.info().sh_degree);
            reader.read(t, Attributes::all(), &mut state).unwrap();
            state
        })
        .collect()
}

/// Reads the frame stream `bytes`. Returns the time and all attributes of each frame.
fn read(bytes: impl Read) -> Result<Vec<(f64, Gaussians)>> {
    let mut stream = FrameStream::open(bytes, Path::new("test"), ReadLimit::NONE)?;
    let mut state = stream.take_constant_attributes();
    let mut frames = Vec::new();
    while let Some(time) = stream.next_frame(&mut state)? {
        frames.push((time, state.clone()));
    }
    assert_eq!(stream.next_frame(&mut state)?, None, "the end stays the end");
    Ok(frames)
}

/// Returns the message of the error with which reading the stream `bytes` fails.
fn refusal(bytes: &[u8]) -> String {
    let error = read(bytes).unwrap_err();
    assert!(matches!(error, Error::Input(_)), "{error}");
    error.to_string()
}

/// Reader of the bytes in the first field that returns 1 to 7 bytes at a time, as pipes do. Some calls fail with
/// `Interrupted`. The second field is the number of bytes that the last call could return.
struct SlowReader<'a>(&'a [u8], usize);

impl Read for SlowReader<'_> {
    fn read(&mut self, into: &mut [u8]) -> std::io::Result<usize> {
        self.1 = self.1 % 7 + 1;
        if self.1 == 3 {
            return Err(ErrorKind::Interrupted.into());
        }
        let len = into.len().min(self.1);
        self.0.read(&mut into[..len])
    }
}

#[test]
fn streams_are_read_bit_for_bit_in_pieces_of_any_size() {
    let (scene, bytes, _) = written();
    let expected: Vec<(f64, Gaussians)> = scene.info().times.iter().copied().zip(states(&scene)).collect();
    assert_eq!(read(&bytes[..]).unwrap(), expected);
    assert_eq!(read(SlowReader(&bytes, 0)).unwrap(), expected);
}

#[test]
fn nan_bits_and_any_set_of_varying_attributes_survive() {
    for varying in [Attributes::empty(), Attributes::all(), Attributes::SH] {
        let mut state = Gaussians::zeros(2, 0);
        for (i, bits) in [0x7fc0_1234, 0x8000_0000, 0xff80_0000, 1].into_iter().enumerate() {
            state.rotation.plane_mut(i)[1] = f32::from_bits(bits);
        }
        let header = StreamHeader { count: 2, sh_degree: 0, varying, is_unlinked: false };
        let mut bytes = Vec::new();
        let mut stream = StreamWriter::new(&mut bytes, Path::new("test"), header, &state).unwrap();
        stream.write_frame(-1.5, &state).unwrap();
        stream.finish().unwrap();
        let frames = read(&bytes[..]).unwrap();
        let found: Vec<u32> = frames[0].1.rotation.planes().iter().map(|value| value.to_bits()).collect();
        let expected: Vec<u32> = state.rotation.planes().iter().map(|value| value.to_bits()).collect();
        assert_eq!((frames.len(), frames[0].0, found), (1, -1.5, expected), "{varying:?}");
    }
}

#[test]
fn a_stream_may_have_no_gaussians_or_no_frames() {
    let header = StreamHeader { count: 0, sh_degree: 3, varying: Attributes::POSITION, is_unlinked: false };
    for frames in [0, 2] {
        let state = Gaussians::zeros(0, 3);
        let mut bytes = Vec::new();
        let mut stream = StreamWriter::new(&mut bytes, Path::new("test"), header, &state).unwrap();
        (0..frames).for_each(|t| stream.write_frame(f64::from(t), &state).unwrap());
        stream.finish().unwrap();
        assert_eq!(bytes.len(), 32 + 24 * (frames as usize + 1));
        assert_eq!(read(&bytes[..]).unwrap().len(), frames as usize);
    }
}

#[test]
fn truncated_streams_name_the_number_of_complete_frames() {
    let (_, bytes, starts) = written();
    for cut in (0..bytes.len()).step_by(97).chain(starts.iter().copied()).chain([bytes.len() - 1]) {
        let message = refusal(&bytes[..cut]);
        assert!(message.contains(&format!("byte {cut}:")), "{message}");
        let complete = starts.iter().filter(|&&start| start <= cut).count();
        let expected = match complete {
            0 => "before its first frame".to_owned(),
            2 => "after 1 complete frame, without its end mark".to_owned(),
            _ => format!("after {} complete frames, without its end mark", complete - 1),
        };
        assert!(message.contains(&expected), "cut at {cut}: {expected:?} is not in {message:?}");
    }
}

/// Returns the bytes of the test stream with a changed mark (fixed-size part) before frame `frame`: in the mark,
/// `field` replaces the bytes from offset `offset` on.
fn with_mark_bytes(frame: usize, offset: usize, field: &[u8]) -> Vec<u8> {
    let (_, mut bytes, starts) = written();
    bytes[starts[frame] + offset..][..field.len()].copy_from_slice(field);
    bytes
}

#[test]
fn illegal_fields_are_named_with_frame_and_byte() {
    let (_, bytes, starts) = written();
    let frame = starts[1] - starts[0] - FrameMark::BYTES;
    let header = |offset: usize, field: &[u8]| {
        let mut changed = bytes.clone();
        changed[offset..][..field.len()].copy_from_slice(field);
        changed
    };
    let at = |frame: usize, offset: usize| format!("frame {frame}, byte {}", starts[frame] + offset);
    let cases: [(Vec<u8>, String, &str); 17] = [
        (header(0, b"Loading "), "byte 0".into(), "Loading "),
        (header(8, &[3]), "byte 8".into(), "version 3"),
        (header(8, &[2]), "byte 16".into(), "frames say how many"),
        (header(12, &[4]), "byte 12".into(), "found 4"),
        (header(20, &[1]), "byte 16".into(), "fewer than 2^32"),
        (header(24, &[32]), "byte 24".into(), "0x20"),
        (header(28, &[1]), "byte 28".into(), "reserved"),
        (with_mark_bytes(2, 0, b"step"), at(2, 0), "step"),
        (with_mark_bytes(2, 4, &[1]), at(2, 4), "expected frame 2, found frame 1"),
        (with_mark_bytes(1, 4, &[3]), at(1, 4), "expected frame 1, found frame 3"),
        (with_mark_bytes(1, 8, &f64::NAN.to_le_bytes()), at(1, 8), "NaN"),
        (with_mark_bytes(2, 8, &(1.0f64 / 3.0).to_le_bytes()), at(2, 8), "above 0.333"),
        (with_mark_bytes(2, 8, &(-1.0f64).to_le_bytes()), at(2, 8), "found -1"),
        (with_mark_bytes(1, 16, &(frame as u64 + 32).to_le_bytes()), at(1, 16), "as 151 Gaussians have"),
        (with_mark_bytes(1, 16, &(frame as u64 + 12).to_le_bytes()), at(1, 16), "no number of Gaussians"),
        (with_mark_bytes(T, 4, &[3]), at(T, 4), "4 frames, which arrived"),
        (with_mark_bytes(T, 12, &[3]), at(T, 8), "reserved"),
    ];
    for (bytes, place, part) in cases {
        let message = refusal(&bytes);
        assert!(message.contains(&place) && message.contains(part), "{place:?} and {part:?} in {message:?}");
    }
}

#[test]
fn swapped_lost_or_repeated_frames_are_refused() {
    let (_, bytes, starts) = written();
    let part = |from: usize, to: usize| &bytes[starts[from]..starts[to]];
    let (head, end) = (&bytes[..starts[0]], &bytes[starts[T]..]);
    for (frames, message) in [
        (vec![part(0, 1), part(2, 3), part(1, 2), part(3, 4)], "expected frame 1, found frame 2"),
        (vec![part(0, 1), part(2, 4)], "expected frame 1, found frame 2"),
        (vec![part(0, 2), part(1, 4)], "expected frame 2, found frame 1"),
        (vec![part(0, 3)], "expected 3 frames, which arrived, found an end mark after 4"),
    ] {
        let stream = [&[head], &frames[..], &[end]].concat().concat();
        let found = refusal(&stream);
        assert!(found.contains(message), "{message:?} is not in {found:?}");
    }
}

#[test]
fn text_printed_into_the_stream_is_refused() {
    // A text shorter than the name of the format is quoted as it came.
    let message = refusal(b"hello\n");
    assert!(message.contains(r#"found "hello\n""#) && !message.contains(r"\x00"), "{message}");
    let (_, bytes, starts) = written();
    let mut within = bytes.clone();
    within.splice(starts[1] + 100..starts[1] + 100, *b"epoch 7\n");
    let message = refusal(&within);
    assert!(message.contains("frame 2") && message.contains("standard error"), "{message}");
    let message = refusal(&[&bytes[..], b"done\n"].concat());
    assert!(message.contains(&format!("byte {}", bytes.len())) && message.contains("after the end mark"), "{message}");
}

#[test]
fn a_huge_count_in_the_header_allocates_no_memory() {
    // The header states 2³² − 1 Gaussians, 240 GiB, but no data follows.
    let header =
        StreamHeader { count: u32::MAX as usize, sh_degree: 3, varying: Attributes::POSITION, is_unlinked: false };
    let message = refusal(&[&header.to_bytes()[..], &[0; 5000]].concat());
    assert!(message.contains("constant column rotation"), "{message}");
}

#[test]
fn the_writer_refuses_illegal_frames() {
    let header = StreamHeader { count: 3, sh_degree: 0, varying: Attributes::POSITION, is_unlinked: false };
    let state = Gaussians::zeros(3, 0);
    let mut stream = StreamWriter::new(Vec::new(), Path::new("test"), header, &state).unwrap();
    stream.write_frame(1.0, &state).unwrap();
    for time in [1.0, 0.5, f64::NAN, f64::INFINITY] {
        assert!(stream.write_frame(time, &state).is_err(), "{time}");
    }
    assert!(stream.write_frame(2.0, &Gaussians::zeros(4, 0)).is_err());
}
