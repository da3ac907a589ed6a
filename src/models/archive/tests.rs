//! Tests of layouts in archives. A layout states which bytes of each file of a model are stored as values. Damaged and
//! hostile layouts are refused, and files are restored to the byte.

use std::fs;
use std::path::Path;

use super::layout::{Field, FileLayout, LAYOUT, Layout, Span, Values, plain_path, rest_name};
use super::{restored_output_kind, unpack};
use crate::archive::{ArchiveContent, Column};
use crate::deform::Tensor;
use crate::model::{AttributeValues, Gaussians};
use crate::outputs::kind::OutputKind;

/// Number of Gaussians of the test archive.
const COUNT: usize = 3;

/// Returns the content of an archive of two files. The first file consists of a header, rows of Gaussians, a tensor,
/// zeros and further bytes. The second file has no values: the archive stores all its bytes unchanged.
fn content() -> ArchiveContent {
    let mut content = ArchiveContent { cloud: Gaussians::zeros(COUNT, 0), ..ArchiveContent::default() };
    (0..COUNT).for_each(|i| content.cloud.position.set_row(i, [i as f32, 0.5, -1.0]));
    let values = AttributeValues::from_planes(1, vec![0.25, 0.5, 1.0]);
    content.columns.push(Column { name: "width".into(), values, first_frame: None });
    content.tensors.insert("weights".into(), Tensor { shape: vec![2], data: vec![1.5, -2.0] });
    content.extra_bytes = (0..2 * COUNT as u8).collect();
    content.files.insert(rest_name(0), b"headtail".to_vec());
    content.files.insert(rest_name(1), b"other".to_vec());
    content
}

/// Returns a layout that matches [`content`].
fn layout() -> Layout {
    let rows = vec![Field::F32(0), Field::Half(14), Field::Byte(14), Field::Bytes(2), Field::Zeros(1)];
    let spans = vec![
        Span { at: 4, of: Values::Rows(rows) },
        Span { at: 34, of: Values::Tensor("weights".into()) },
        Span { at: 42, of: Values::Zeros(3) },
    ];
    let file = |path: &str, spans| FileLayout { path: path.to_owned(), spans };
    Layout { folder: true, files: vec![file("a/model.bin", spans), file("b", Vec::new())] }
}

/// Returns the archive content `content` with the text `text` in place of its layout, which is stored as JSON.
fn with_text(mut content: ArchiveContent, text: &str) -> ArchiveContent {
    content.files.insert(LAYOUT.to_owned(), text.as_bytes().to_vec());
    content
}

fn with_layout(layout: &Layout) -> ArchiveContent {
    with_text(content(), &serde_json::to_string(layout).unwrap())
}

/// Checks that unpacking `content` fails and writes nothing outside the output folder. Returns the error message.
fn refusal(content: &ArchiveContent) -> String {
    let folder = tempfile::tempdir().unwrap();
    let to = folder.path().join("deep/out");
    fs::create_dir_all(&to).unwrap();
    let message = unpack(content, Path::new("a.gsz"), &to).expect_err("it must be refused").to_string();
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    assert_eq!(fs::read_dir(folder.path().join("deep")).unwrap().count(), 1);
    message
}

#[test]
fn files_are_restored_around_the_values() {
    let folder = tempfile::tempdir().unwrap();
    unpack(&with_layout(&layout()), Path::new("a.gsz"), folder.path()).unwrap();
    let mut expected = b"head".to_vec();
    for (i, (half, byte)) in [(0x3400u16, 64), (0x3800, 128), (0x3C00, 255)].into_iter().enumerate() {
        expected.extend((i as f32).to_le_bytes());
        expected.extend(half.to_le_bytes());
        expected.extend([byte, 2 * i as u8, 2 * i as u8 + 1, 0]);
    }
    expected.extend([1.5f32, -2.0].map(f32::to_le_bytes).concat());
    expected.extend([0; 3]);
    expected.extend(b"tail");
    assert_eq!(fs::read(folder.path().join("a/model.bin")).unwrap(), expected);
    assert_eq!(fs::read(folder.path().join("b")).unwrap(), b"other");
}

#[test]
fn a_single_file_has_the_kind_of_its_name() {
    for (name, kind) in [("model.splatv", OutputKind::Splatv), ("m.ftgs.ply", OutputKind::Ftgs)] {
        let files = vec![FileLayout { path: name.to_owned(), spans: Vec::new() }];
        let content = with_layout(&Layout { folder: false, files });
        assert_eq!(restored_output_kind(&content, Path::new("a.gsz")).unwrap(), Some(kind));
    }
    assert_eq!(restored_output_kind(&with_layout(&layout()), Path::new("a.gsz")).unwrap(), Some(OutputKind::Model));
    assert_eq!(restored_output_kind(&content(), Path::new("a.gsz")).unwrap(), None);
}

#[test]
fn paths_outside_the_output_are_refused() {
    let long = "x".repeat(300);
    for path in [
        "",
        ".",
        "..",
        "../x",
        "a/../../x",
        "/x",
        "a//b",
        "a/",
        "C:\\x",
        "a\\b",
        "a\0b",
        "a\nb",
        ".hidden",
        "x.",
        "x ",
        "é",
        "~",
        "con",
        "NUL.txt",
        "a/Com1",
        "lpt9.ply",
        &long,
    ] {
        let mut layout = layout();
        layout.files[1].path = path.to_owned();
        let message = refusal(&with_layout(&layout));
        assert!(message.contains("a.gsz, layout: expected relative paths"), "{path:?}: {message}");
    }
}

#[test]
fn names_of_files_become_plain() {
    for (name, plain) in [
        ("a/config.yaml", Some("a/config.yaml")),
        ("é (1).yaml", Some("_ _1_.yaml")),
        ("a\\b", Some("a_b")),
        ("nul", None),
        ("../x", None),
        (".hidden", None),
    ] {
        assert_eq!(plain_path(name).as_deref(), plain, "{name}");
    }
}

#[test]
fn layouts_that_do_not_match_the_archive_are_refused() {
    let change = |change: &dyn Fn(&mut Layout)| {
        let mut layout = layout();
        change(&mut layout);
        refusal(&with_layout(&layout))
    };
    let expect = |message: String, says: &str| assert!(message.contains(says), "{message}, expected {says}");
    let unmatched = "places of values that match the archive";
    expect(change(&|layout| layout.files[1].path = "A/Model.bin".into()), "one file for each path");
    expect(change(&|layout| layout.folder = false), "expected one file");
    expect(change(&|layout| layout.files.push(layout.files[1].clone())), "one file for each path");
    let third = FileLayout { path: "c".into(), spans: Vec::new() };
    expect(change(&|layout| layout.files.push(third.clone())), unmatched);
    for at in [0, 3, 1000, u64::MAX] {
        expect(change(&|layout| layout.files[0].spans[1].at = at), unmatched);
    }
    let first = |fields: Vec<Field>, says: &str| {
        expect(change(&|layout| layout.files[0].spans[0].of = Values::Rows(fields.clone())), says);
    };
    for plane in [15, 1000, usize::MAX] {
        first(vec![Field::F32(plane)], unmatched);
    }
    first(vec![Field::Bytes(3)], unmatched);
    first(vec![Field::Bytes(2), Field::Bytes(1)], unmatched);
    for bytes in [1 << 40, usize::MAX] {
        first(vec![Field::Zeros(bytes)], "files of at most");
        first(vec![Field::Bytes(bytes), Field::Bytes(bytes)], "files of at most");
    }
    expect(change(&|layout| layout.files[0].spans[2].of = Values::Zeros(u64::MAX)), "files of at most");
    expect(change(&|layout| layout.files[0].spans[1].of = Values::Tensor("none".into())), unmatched);
    for text in ["", "[]", "{", r#"{"folder":true}"#, r#"{"folder":true,"files":[],"more":1}"#, &"[".repeat(5000)] {
        expect(refusal(&with_text(content(), text)), "the files of a model as JSON");
    }
    expect(refusal(&with_text(content(), &" ".repeat(5 << 20))), "at most 4194304 bytes");
    // A ZIP archive whose directory is damaged.
    let mut damaged = with_layout(&layout());
    damaged.files.insert(rest_name(0), b"PK\x03\x04tail".to_vec());
    expect(refusal(&damaged), unmatched);
}
