use std::env;
use std::fmt::Write as _;
use std::fs;

use proptest::prelude::*;

use super::*;

/// Returns the property names of a model of SH degree 1 without normals. One extra property is among them.
pub(crate) fn names() -> Vec<String> {
    let mut names: Vec<String> = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from).to_vec();
    names.extend((0..9).map(|k| format!("f_rest_{k}")));
    names.extend(["opacity", "confidence", "scale_0", "scale_1", "scale_2"].map(String::from));
    names.extend((0..4).map(|k| format!("rot_{k}")));
    names
}

/// Returns the value of property number `p` of Gaussian `i` in these tests. It is exact in every number type except the
/// 8-bit ones.
fn value(i: usize, p: usize) -> i16 {
    (100 * i + p) as i16 - 50
}

fn header(format: &str, kind: &str, names: &[String], count: &str, line_end: &str) -> String {
    let mut text = format!("ply\nformat {format} 1.0\ncomment SplatRenderMode: mip\nelement vertex {count}\n");
    names.iter().for_each(|name| writeln!(text, "property {kind} {name}").unwrap());
    (text + "end_header\n").replace('\n', line_end)
}

/// Returns the bytes of a PLY file of `count` Gaussians in the encoding `format`. The properties `names` all have the
/// type `kind`, and the lines of the header end in `line_end`.
pub(crate) fn file(format: &str, kind: &str, names: &[String], count: usize, line_end: &str) -> Vec<u8> {
    let mut bytes = header(format, kind, names, &count.to_string(), line_end).into_bytes();
    for i in 0..count {
        for p in 0..names.len() {
            let v = value(i, p);
            if format == "ascii" {
                bytes.extend(format!("{v} ").bytes());
                continue;
            }
            let mut number = match kind {
                "float" => f32::from(v).to_le_bytes().to_vec(),
                "double" => f64::from(v).to_le_bytes().to_vec(),
                "int" => i32::from(v).to_le_bytes().to_vec(),
                "short" => v.to_le_bytes().to_vec(),
                _ => panic!("{kind}"),
            };
            if format == "binary_big_endian" {
                number.reverse();
            }
            bytes.extend(number);
        }
        if format == "ascii" {
            bytes.extend(line_end.bytes());
        }
    }
    bytes
}

fn float_file(count: usize) -> Vec<u8> {
    file("binary_little_endian", "float", &names(), count, "\n")
}

/// Writes `bytes` to a file and opens it as a PLY.
fn open(bytes: &[u8]) -> Result<Ply> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    fs::write(&path, bytes).unwrap();
    Ply::open(&path)
}

fn refusal(bytes: &[u8]) -> String {
    let error = open(bytes).unwrap_err();
    assert!(matches!(error, Error::Input(_)), "{error}");
    error.to_string()
}

fn all(ply: &Ply) -> Gaussians {
    let mut out = Gaussians::zeros(0, ply.sh_degree());
    ply.gather_range(0..ply.count(), Attributes::all(), &mut out).unwrap();
    out
}

/// Returns the Gaussians that [`file`] writes for the same `count` and `names`. They are assembled by property name, so
/// independently of the layout code under test.
fn expected(count: usize, names: &[String]) -> Gaussians {
    let mut out = Gaussians::zeros(count, 1);
    for i in 0..count {
        let property = |name: &str| f32::from(value(i, names.iter().position(|n| n == name).unwrap()));
        out.position.set_row(i, [property("x"), property("y"), property("z")]);
        out.rotation.set_row(i, [property("rot_0"), property("rot_1"), property("rot_2"), property("rot_3")]);
        out.log_scale.set_row(i, [property("scale_0"), property("scale_1"), property("scale_2")]);
        out.opacity_logit.set_row(i, [property("opacity")]);
        // For SH degree 1, coefficients 1, 2, 3 of red are f_rest_0..2, those of green 3..5, and those of blue 6..8.
        out.sh.set_row(
            i,
            [
                "f_dc_0", "f_dc_1", "f_dc_2", "f_rest_0", "f_rest_3", "f_rest_6", "f_rest_1", "f_rest_4", "f_rest_7",
                "f_rest_2", "f_rest_5", "f_rest_8",
            ]
            .map(property),
        );
    }
    out
}

#[test]
fn every_encoding_type_order_and_line_end_reads_the_same() {
    let mut reversed = names();
    reversed.reverse();
    for names in [names(), reversed] {
        for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
            for kind in ["float", "double", "int", "short"] {
                for line_end in ["\n", "\r\n"] {
                    // 130 rows are more than the reader reads together.
                    let ply = open(&file(format, kind, &names, 130, line_end)).unwrap();
                    assert_eq!((ply.count(), ply.sh_degree()), (130, 1));
                    assert_eq!(ply.comments(), ["SplatRenderMode: mip"]);
                    assert!(all(&ply) == expected(130, &names), "{format} {kind} {line_end:?}");
                }
            }
        }
    }
}

#[test]
fn any_list_of_ids_reads_the_same_rows() {
    let ply = open(&float_file(300)).unwrap();
    let whole = all(&ply);
    let ids: Vec<u32> = (0..290).map(|i| (i * 97 + 13) % 300).collect();
    let mut out = Gaussians::zeros(0, 1);
    ply.gather(&Ids::List(&ids), Attributes::all(), &mut out).unwrap();
    for (i, &id) in ids.iter().enumerate() {
        assert_eq!(out.sh.row::<12>(i), whole.sh.row::<12>(id as usize));
        assert_eq!(out.position.row::<3>(i), whole.position.row::<3>(id as usize));
    }
    ply.gather_range(120..260, Attributes::ROTATION, &mut out).unwrap();
    assert_eq!(out.rotation.plane(2), &whole.rotation.plane(2)[120..260]);
}

#[test]
fn unrequested_attributes_are_unchanged() {
    let ply = open(&float_file(3)).unwrap();
    let mut out = Gaussians::zeros(3, 1);
    out.sh.planes_mut().fill(7.0);
    ply.gather_range(0..3, Attributes::all().difference(Attributes::SH), &mut out).unwrap();
    assert!(out.sh.planes().iter().all(|&x| x == 7.0));
    assert_eq!(out.position, expected(3, &names()).position);
}

#[test]
fn ids_beyond_the_last_gaussian_are_refused() {
    let ply = open(&float_file(3)).unwrap();
    let mut out = Gaussians::zeros(0, 1);
    assert!(ply.gather_range(1..4, Attributes::all(), &mut out).unwrap_err().to_string().contains("Gaussian 3 "));
    assert!(
        ply.gather(&Ids::List(&[0, 9]), Attributes::all(), &mut out).unwrap_err().to_string().contains("Gaussian 9 ")
    );
    ply.gather_range(3..3, Attributes::all(), &mut out).unwrap();
}

#[test]
fn every_bit_of_an_f32_survives() {
    let patterns = [0x7fc0_1234u32, 0x7f80_0001, 0xff80_0000, 0x8000_0000, 1, 0x7f7f_ffff];
    let names = names();
    let mut bytes = header("binary_little_endian", "float", &names, "6", "\n").into_bytes();
    for pattern in patterns {
        (0..names.len()).for_each(|_| bytes.extend(pattern.to_le_bytes()));
    }
    let out = all(&open(&bytes).unwrap());
    for plane in 0..3 {
        assert_eq!(out.position.plane(plane).iter().map(|x| x.to_bits()).collect::<Vec<_>>(), patterns);
    }
}

#[test]
fn surfel_thickness_is_a_thousandth_of_the_smaller_axis() {
    let names: Vec<String> = names().into_iter().filter(|name| name != "scale_2").collect();
    let out = all(&open(&file("binary_little_endian", "float", &names, 2, "\n")).unwrap());
    for i in 0..2 {
        let [a, b, c] = out.log_scale.row::<3>(i);
        let ratio = f64::from(c - a.min(b)).exp();
        assert!((ratio - 1e-3).abs() < 1e-8, "thickness over smaller axis: got {ratio}, expected 1e-3");
    }
}

#[test]
fn extra_elements_and_bytes_are_skipped() {
    let names = names();
    let plain = float_file(2);
    let text = header("binary_little_endian", "float", &names, "2", "\n");
    let body = &plain[text.len()..];
    let before = "element camera 3\nproperty uchar id\nproperty double f\n";
    let after = "element note 1\nproperty uint32 code\nend_header\n";
    let text = text.replace("element vertex", &format!("{before}element vertex")).replace("end_header\n", after);
    let bytes = [text.as_bytes(), &[9; 27], body, &[5; 4], b"trailing"].concat();
    let ply = open(&bytes).unwrap();
    assert_eq!(all(&ply), expected(2, &names));
    let (mut lead, mut tail) = (Vec::new(), Vec::new());
    ply.write_lead(&mut lead).and_then(|()| ply.write_tail(&mut tail)).unwrap();
    assert_eq!((&lead[..], &tail[..]), (&[9; 27][..], &b"\x05\x05\x05\x05trailing"[..]));
    assert_eq!(ply.bytes_around(), [27, 12]);

    let list = text.replace("property uchar id", "property list uchar int vertex_indices");
    let message = refusal(list.as_bytes());
    assert!(message.contains("list property \"vertex_indices\"") && message.contains("camera"), "{message}");
    let in_rows = text.replace("property float f_dc_0", "property list uchar float f_dc_0");
    assert!(refusal(in_rows.as_bytes()).contains("in element \"vertex\""));
}

#[test]
fn elements_with_lists_are_skipped_after_the_gaussians() {
    let names = names();
    for format in ["ascii", "binary_little_endian"] {
        let plain = file(format, "float", &names, 2, "\n");
        let text = header(format, "float", &names, "2", "\n");
        let lists =
            "element face 1\nproperty list uchar int vertex_indices\nelement note 1\nproperty int a\nend_header\n";
        let empty = "element face 0\nproperty list uchar int vertex_indices\nelement vertex";
        for (head, skipped) in [
            (text.replace("end_header\n", lists), vec!["face", "note"]),
            (text.replace("element vertex", empty), vec!["face"]),
        ] {
            let ply = open(&[head.as_bytes(), &plain[text.len()..], b"3 0 1 2"].concat()).unwrap();
            assert_eq!(all(&ply), expected(2, &names));
            assert_eq!(ply.header().skipped, skipped, "{format}");
            let little = header("binary_little_endian", "float", &names, "2", "\n");
            let found = ply.header().text_for(2, |name| Some(name.to_owned()));
            assert_eq!(String::from_utf8(found).unwrap(), little);
        }
    }
}

#[test]
fn every_sh_degree_is_read_up_to_degree_3() {
    for (stored, rest) in [(0usize, 0usize), (1, 9), (2, 24), (3, 45), (4, 72)] {
        let mut names: Vec<String> = names().into_iter().filter(|name| !name.starts_with("f_rest_")).collect();
        names.extend((0..rest).map(|k| format!("f_rest_{k}")));
        let ply = open(&file("binary_little_endian", "float", &names, 2, "\n")).unwrap();
        assert_eq!(ply.sh_degree(), stored.min(3));
        let (found, per_channel) = (all(&ply), rest / 3);
        for k in 1..(stored.min(3) + 1).pow(2) {
            for channel in 0..3 {
                let name = format!("f_rest_{}", channel * per_channel + k - 1);
                let place = names.iter().position(|other| *other == name).unwrap();
                assert_eq!(found.sh.plane(3 * k + channel)[1], f32::from(value(1, place)), "{stored}: {name}");
            }
        }
    }
}

#[test]
fn infinite_opacity_logits_become_finite() {
    let names = names();
    let place = names.iter().position(|name| name == "opacity").unwrap();
    let mut bytes = float_file(3);
    let start = bytes.len() - 12 * names.len();
    for (row, logit) in [f32::INFINITY, f32::NEG_INFINITY, f32::NAN].into_iter().enumerate() {
        bytes[start + 4 * (row * names.len() + place)..][..4].copy_from_slice(&logit.to_le_bytes());
    }
    let found = all(&open(&bytes).unwrap());
    assert_eq!(found.opacity_logit.plane(0)[..2], [100.0, -100.0]);
    assert!(found.opacity_logit.plane(0)[2].is_nan());
}

#[test]
fn other_files_are_refused_as_not_ply() {
    for bytes in [&b""[..], b"PK\x03\x04zip", b"plyx\n", &[0; 5000]] {
        assert!(refusal(bytes).contains("not a PLY"), "{:?}", String::from_utf8_lossy(bytes));
    }
    let folder = tempfile::tempdir().unwrap();
    assert!(matches!(Ply::open(folder.path()), Err(Error::Io { .. })));
    assert!(matches!(Ply::open(&folder.path().join("none.ply")), Err(Error::Io { .. })));
}

#[test]
fn a_missing_property_is_named() {
    let message_for = |names: &[String]| refusal(&file("binary_little_endian", "float", names, 2, "\n"));
    for name in ["x", "f_dc_2", "opacity", "scale_1", "rot_3"] {
        let names: Vec<String> = names().into_iter().filter(|n| n != name).collect();
        let message = message_for(&names);
        assert!(message.contains(&format!("property {name},")), "{message}");
    }
    let names: Vec<String> = names().into_iter().filter(|n| n != "f_rest_3").collect();
    assert!(
        message_for(&names).contains("0, 9, 24, 45 or 72") && message_for(&names).contains("found 8"),
        "{}",
        message_for(&names)
    );
    assert!(message_for(&["packed_position".to_owned()]).contains("compressed PLY"));
}

#[test]
fn a_truncated_body_is_refused_with_its_length() {
    let bytes = float_file(10);
    let message = refusal(&bytes[..bytes.len() - 1]);
    let stride = 4 * names().len();
    assert!(message.contains(&format!("10 rows × {stride} bytes = {} bytes", 10 * stride)), "{message}");
    assert!(message.contains(&format!("found {} bytes", 10 * stride - 1)), "{message}");
}

#[test]
fn absurd_counts_are_refused_before_allocation() {
    for format in ["ascii", "binary_little_endian"] {
        for count in ["4000000000", "4294967296", "18446744073709551615", "999999999999999999999", "-1", "many"] {
            let message = refusal(header(format, "float", &names(), count, "\n").as_bytes());
            assert!(message.contains("expected"), "{message}");
        }
        // Rows without properties take no bytes; a huge number of them must not keep the reader busy.
        let rest = header(format, "float", &names(), "0", "\n");
        let endless = rest.replace("element vertex", "element nothing 18446744073709551615\nelement vertex");
        assert_eq!(open(endless.as_bytes()).unwrap().count(), 0);
    }
}

#[test]
fn invalid_words_in_text_are_named_with_their_line() {
    let good = String::from_utf8(file("ascii", "float", &names(), 3, "\n")).unwrap();
    // Number of the line: the header has two lines before the element, one per property and one at its end, and blank
    // lines count.
    let row = 4 + names().len() + 1 + 1;
    let message = refusal(good.replace("\n50 ", "\n\nfifty ").as_bytes());
    assert!(message.contains(&format!("line {}", row + 2)) && message.contains("\"fifty\""), "{message}");
    let message = refusal(good.replace("\n50 ", "\n").as_bytes());
    assert!(message.contains(&format!("line {}", row + 1)) && message.contains("found 23"), "{message}");
    let cut: String = good.lines().take(row + 1).map(|line| line.to_owned() + "\n").collect();
    let message = refusal(cut.as_bytes());
    assert!(message.contains("3 rows"), "{message}");
    let special = good.replace("\n50 51 52 ", "\nnan -inf 1e-45 ");
    let out = all(&open(special.as_bytes()).unwrap());
    assert!(out.position.row::<3>(1)[0].is_nan());
    assert_eq!(out.position.row::<3>(1)[1..], [f32::NEG_INFINITY, f32::from_bits(1)]);
}

#[test]
fn contradictory_headers_are_refused_with_the_line() {
    let good = header("binary_little_endian", "float", &names(), "0", "\n");
    open(good.as_bytes()).unwrap();
    for (from, to, says) in [
        ("format binary_little_endian 1.0\n", "", "format line"),
        ("binary_little_endian", "binary_middle_endian", "line 2"),
        ("property float y", "property float x", "\"x\" twice"),
        ("property float y", "property quad y", "\"quad\""),
        ("property float y", "nonsense", "\"nonsense\""),
        ("end_header", "element vertex 3\nend_header", "\"vertex\" twice"),
        ("element vertex 0", "element points 0", "\"vertex\""),
        ("element vertex 0\n", "", "an element before"),
        ("end_header\n", "", "end_header line"),
        ("end_header\n", "end_header", "end_header line"),
    ] {
        let message = refusal(good.replace(from, to).as_bytes());
        assert!(message.contains(says), "{from:?} -> {to:?}: {message}");
    }
}

/// Writes `bytes` to `path`, opens and reads the file, and returns whether it was accepted. Only a panic or a hang
/// fails the test.
fn open_and_read(bytes: &[u8], path: &Path) -> bool {
    fs::write(path, bytes).unwrap();
    match Ply::open(path) {
        Ok(ply) => {
            let mut out = Gaussians::default();
            ply.gather_range(0..ply.count(), Attributes::all(), &mut out).unwrap();
            assert!(ply.count() <= bytes.len() && out.len() == ply.count());
            true
        }
        Err(error) => {
            assert!(error.to_string().contains("a.ply"), "an error that names no file: {error}");
            false
        }
    }
}

#[test]
fn truncated_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
        let bytes = file(format, "float", &names(), 3, "\n");
        // A text file that lacks the space and line end after its last number, or some digits of this number, is still
        // valid.
        let whole = if format == "ascii" { bytes.len() - 4 } else { bytes.len() };
        for len in 0..whole {
            assert!(!open_and_read(&bytes[..len], &path), "{format} cut to {len} of {} bytes", bytes.len());
        }
        assert!(open_and_read(&bytes, &path));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn damaged_files_never_cause_a_panic(
        format in prop::sample::select(vec!["ascii", "binary_little_endian", "binary_big_endian"]),
        flips in prop::collection::vec((any::<prop::sample::Index>(), 0..8u32), 1..6),
        splice in prop::option::of((any::<prop::sample::Index>(), "[ -~\n]{0,12}")),
    ) {
        let folder = tempfile::tempdir().unwrap();
        let mut bytes = file(format, "float", &names(), 3, "\n");
        for (at, bit) in flips {
            let at = at.index(bytes.len());
            bytes[at] ^= 1 << bit;
        }
        if let Some((at, text)) = splice {
            let at = at.index(bytes.len());
            bytes.splice(at..at, text.bytes());
        }
        open_and_read(&bytes, &folder.path().join("a.ply"));
    }
}

#[test]
#[ignore = "needs the trained models"]
fn real_models_open() {
    let data = shared_data();
    for (name, count, degree) in [
        ("deform2/point_cloud/iteration_600/point_cloud.ply", 20_883, 3),
        ("static/guitar.ply", 90_854, 0),
        ("static/biker.ply", 152_746, 0),
    ] {
        let ply = Ply::open(&data.join(name)).unwrap();
        assert_eq!((ply.count(), ply.sh_degree()), (count, degree), "{name}");
    }
}

/// Returns the folder of trained models: `SPLATSIEVE_DATA`, else `../shared/data`, which must exist.
pub(crate) fn shared_data() -> PathBuf {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let data = env::var_os("SPLATSIEVE_DATA").map_or_else(beside, PathBuf::from);
    assert!(data.is_dir(), "no trained models at {} (SPLATSIEVE_DATA)", data.display());
    data
}
