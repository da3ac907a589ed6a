use std::fs;
use std::path::PathBuf;

use super::*;
use crate::files::ply::tests::{file, names, shared_data};
use crate::model::{AttributeValues, NO_SH_LIMIT};

struct TempPly(tempfile::TempDir);

impl TempPly {
    fn new() -> TempPly {
        TempPly(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn open(&self, bytes: &[u8]) -> Ply {
        fs::write(self.path("template.ply"), bytes).unwrap();
        Ply::open(&self.path("template.ply")).unwrap()
    }

    fn write(&self, template: &Ply, rows: &[OutputRow], proxies: &Gaussians) -> Vec<u8> {
        self.write_changed(template, rows, proxies, &ParamDelta::default())
    }

    fn write_changed(&self, template: &Ply, rows: &[OutputRow], proxies: &Gaussians, change: &ParamDelta) -> Vec<u8> {
        write_like_template(template, rows, proxies, change, NO_SH_LIMIT, &self.path("out.ply")).unwrap();
        fs::read(self.path("out.ply")).unwrap()
    }
}

fn kept(ids: impl IntoIterator<Item = u32>) -> Vec<OutputRow> {
    ids.into_iter().map(|template_row| OutputRow { template_row, proxy: None }).collect()
}

fn all(ply: &Ply) -> Gaussians {
    let mut out = Gaussians::zeros(0, ply.sh_degree());
    ply.gather_range(0..ply.count(), Attributes::all(), &mut out).unwrap();
    out
}

/// Returns `len` Gaussians of SH degree `sh_degree` whose values are all different and exactly representable in an i16.
fn proxies(len: usize, sh_degree: usize) -> Gaussians {
    let mut out = Gaussians::zeros(len, sh_degree);
    for (k, column) in Attributes::all().iter().enumerate() {
        let fill = |(i, value): (usize, &mut f32)| *value = (1000 * (k + 1) + i) as f32;
        out.attribute_values_mut(column).planes_mut().iter_mut().enumerate().for_each(fill);
    }
    out
}

/// Returns the bits of all values of the attribute `column`, for comparisons in which NaN equals itself.
fn bits(column: &AttributeValues) -> Vec<u32> {
    column.planes().iter().map(|x| x.to_bits()).collect()
}

#[test]
fn keeping_every_row_gives_the_same_bytes() {
    let temp = TempPly::new();
    for format in ["binary_little_endian", "binary_big_endian"] {
        for line_end in ["\n", "\r\n"] {
            let mut bytes = file(format, "double", &names(), 5, line_end);
            bytes.extend(b"trailing");
            let ply = temp.open(&bytes);
            assert!(temp.write(&ply, &kept(0..5), &Gaussians::default()) == bytes, "{format} {line_end:?}");
        }
    }
}

#[test]
#[ignore = "needs the trained models"]
fn trained_models_are_rewritten_byte_for_byte() {
    let data = shared_data();
    let temp = TempPly::new();
    for name in ["deform2/point_cloud/iteration_600/point_cloud.ply", "static/guitar.ply", "static/biker.ply"] {
        let path = data.join(name);
        let ply = Ply::open(&path).unwrap();
        let written = temp.write(&ply, &kept(0..ply.count() as u32), &Gaussians::default());
        assert!(written == fs::read(&path).unwrap(), "{name}");
        // `write_inria` must give the same bytes, because these files have the INRIA layout and only the normals may
        // differ (zero).
        write_inria(&all(&ply), ply.comments(), &temp.path("inria.ply")).unwrap();
        assert!(fs::read(temp.path("inria.ply")).unwrap() == written, "{name}");
    }
}

#[test]
fn fewer_rows_change_the_count_and_nothing_else() {
    let temp = TempPly::new();
    let bytes = file("binary_big_endian", "float", &names(), 12, "\r\n");
    let ply = temp.open(&bytes);
    let written = temp.write(&ply, &kept([3, 11, 0]), &Gaussians::default());
    let text = String::from_utf8_lossy(ply.header().text.as_slice()).replace("vertex 12", "vertex 3");
    assert_eq!(written, [text.as_bytes(), ply.row(3), ply.row(11), ply.row(0)].concat());
    let none = temp.write(&ply, &[], &Gaussians::default());
    assert_eq!(temp.open(&none).count(), 0);
}

#[test]
fn a_comment_like_a_header_line_is_unchanged() {
    let temp = TempPly::new();
    let text = String::from_utf8(file("ascii", "float", &names(), 2, "\n")).unwrap();
    let text = text.replace("comment SplatRenderMode: mip", "comment element vertex 2\ncomment format ascii 1.0");
    let written = temp.write(&temp.open(text.as_bytes()), &kept([1]), &Gaussians::default());
    let ply = temp.open(&written);
    assert_eq!((ply.count(), ply.comments()), (1, &["element vertex 2".to_owned(), "format ascii 1.0".to_owned()][..]));
}

#[test]
fn a_text_template_becomes_little_endian_binary() {
    let temp = TempPly::new();
    let ply = temp.open(&file("ascii", "double", &names(), 4, "\n"));
    let written = temp.write(&ply, &kept(0..4), &Gaussians::default());
    assert!(written == file("binary_little_endian", "double", &names(), 4, "\n"));
}

#[test]
fn a_proxy_replaces_attributes_and_keeps_extra_properties() {
    let temp = TempPly::new();
    let mut names = names();
    names.extend(["nx", "ny", "nz"].map(String::from));
    let foreign = ["nx", "ny", "nz", "confidence"];
    for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
        for kind in ["float", "double", "int", "short"] {
            let ply = temp.open(&file(format, kind, &names, 6, "\n"));
            let proxies = proxies(2, 1);
            let rows = [
                OutputRow { template_row: 4, proxy: Some(1) },
                OutputRow { template_row: 2, proxy: None },
                OutputRow { template_row: 4, proxy: Some(0) },
            ];
            let written = temp.write(&ply, &rows, &proxies);
            let folder = TempPly::new();
            let out = folder.open(&written);
            let (before, after) = (all(&ply), all(&out));
            for column in Attributes::all().iter() {
                for plane in 0..after.attribute_values(column).width() {
                    let source = |gaussians: &Gaussians, i: usize| gaussians.attribute_values(column).plane(plane)[i];
                    let expected = [source(&proxies, 1), source(&before, 2), source(&proxies, 0)];
                    assert_eq!(
                        after.attribute_values(column).plane(plane),
                        expected,
                        "{format} {kind} {}",
                        column.name()
                    );
                }
            }
            for property in ply.properties().iter().filter(|property| foreign.contains(&property.name.as_str())) {
                let range = property.offset..property.offset + property.scalar.bytes();
                assert_eq!(out.row(0)[range.clone()], ply.row(4)[range], "{}", property.name);
            }
        }
    }
}

#[test]
fn deltas_are_added_and_zeros_leave_the_bytes() {
    let temp = TempPly::new();
    for (format, kind) in [("binary_little_endian", "float"), ("binary_big_endian", "double"), ("ascii", "short")] {
        let ply = temp.open(&file(format, kind, &names(), 3, "\n"));
        let proxies = proxies(1, 1);
        let rows = [OutputRow { template_row: 2, proxy: None }, OutputRow { template_row: 0, proxy: Some(0) }];
        let plain = temp.write(&ply, &rows, &proxies);
        let mut by = Gaussians::zeros(2, 0);
        for column in Attributes::all().difference(Attributes::LOG_SCALE).iter() {
            by.attribute_values_mut(column).plane_mut(0).copy_from_slice(&[3.0, -2.0]);
        }
        let written = temp.write_changed(&ply, &rows, &proxies, &ParamDelta(by.clone()));
        let (folder, other) = (TempPly::new(), TempPly::new());
        let mut expected = all(&folder.open(&plain));
        ParamDelta(by).add_to(&mut expected, Attributes::all());
        assert!(all(&other.open(&written)) == expected, "{format} {kind}");
        let zeros = temp.write_changed(&ply, &rows, &proxies, &ParamDelta(Gaussians::zeros(2, 1)));
        assert!(zeros == plain, "{format} {kind}");
    }
}

#[test]
fn lowering_the_sh_degree_gives_a_file_of_that_degree() {
    let temp = TempPly::new();
    let whole = proxies(4, 3);
    write_inria(&whole, &["of degree 3".to_owned()], &temp.path("whole.ply")).unwrap();
    let ply = Ply::open(&temp.path("whole.ply")).unwrap();
    for degree in 0..=4 {
        let mut fewer = whole.clone();
        fewer.truncate_sh(degree);
        assert_eq!(fewer.sh_degree(), degree.min(3));
        let [expected, found] = ["expected.ply", "found.ply"].map(|name| temp.path(name));
        write_inria(&fewer, ply.comments(), &expected).unwrap();
        write_like_template(&ply, &kept(0..4), &Gaussians::default(), &ParamDelta::default(), degree, &found).unwrap();
        assert!(fs::read(&found).unwrap() == fs::read(&expected).unwrap(), "degree {degree}");
    }
    // Proxies and deltas contain all SH coefficients, and extra properties keep their place.
    let ply = temp.open(&file("binary_big_endian", "double", &names(), 3, "\r\n"));
    let (rows, change) = ([OutputRow { template_row: 2, proxy: Some(0) }, kept([1])[0]], ParamDelta(proxies(2, 1)));
    let mut expected = all(&temp.open(&temp.write_changed(&ply, &rows, &proxies(1, 1), &change)));
    let ply = temp.open(&file("binary_big_endian", "double", &names(), 3, "\r\n"));
    write_like_template(&ply, &rows, &proxies(1, 1), &change, 0, &temp.path("out.ply")).unwrap();
    let found = Ply::open(&temp.path("out.ply")).unwrap();
    expected.truncate_sh(0);
    assert!(all(&found) == expected);
    let left: Vec<String> = names().into_iter().filter(|name| !name.starts_with("f_rest_")).collect();
    assert_eq!(found.properties().iter().map(|property| property.name.clone()).collect::<Vec<_>>(), left);
    let confidence = |ply: &Ply, row: usize| {
        let at = ply.properties().iter().find(|property| property.name == "confidence").unwrap().offset;
        ply.row(row)[at..at + 8].to_vec()
    };
    assert_eq!([0, 1].map(|row| confidence(&found, row)), [2, 1].map(|row| confidence(&ply, row)));
}

#[test]
fn a_surfel_file_drops_the_third_scale_of_proxies() {
    let temp = TempPly::new();
    let names: Vec<String> = names().into_iter().filter(|name| name != "scale_2").collect();
    let ply = temp.open(&file("binary_little_endian", "float", &names, 1, "\n"));
    let proxies = proxies(1, 1);
    let written = temp.write(&ply, &[OutputRow { template_row: 0, proxy: Some(0) }], &proxies);
    let out = TempPly::new();
    let out = all(&out.open(&written));
    assert_eq!(out.log_scale.row::<2>(0), proxies.log_scale.row::<2>(0));
    assert_eq!(out.rotation, proxies.rotation);
}

#[test]
fn missing_rows_and_proxies_are_refused() {
    let temp = TempPly::new();
    let ply = temp.open(&file("binary_little_endian", "float", &names(), 2, "\n"));
    let refusal = |rows: &[OutputRow], proxies: &Gaussians| {
        write_like_template(&ply, rows, proxies, &ParamDelta::default(), NO_SH_LIMIT, &temp.path("none.ply"))
            .unwrap_err()
            .to_string()
    };
    assert!(refusal(&kept([2]), &Gaussians::default()).contains("Gaussian 2 "));
    assert!(refusal(&[OutputRow { template_row: 0, proxy: Some(1) }], &proxies(1, 1)).contains("proxy 1 "));
    assert!(refusal(&[OutputRow { template_row: 0, proxy: Some(0) }], &proxies(1, 3)).contains("48 SH planes"));
    let short = ParamDelta(Gaussians::zeros(1, 1));
    let path = temp.path("none.ply");
    let message = write_like_template(&ply, &kept([0, 1]), &Gaussians::default(), &short, NO_SH_LIMIT, &path);
    assert!(message.unwrap_err().to_string().contains("1 changes of 2 rows"));
    assert!(!temp.path("none.ply").exists());
}

#[test]
fn the_inria_layout_round_trips_at_every_degree() {
    let temp = TempPly::new();
    for degree in 0..=3 {
        let mut gaussians = proxies(5, degree);
        gaussians.position.set_row(0, [f32::from_bits(0x7fc0_1234), -0.0, 1e-45]);
        let path = temp.path("a.ply");
        write_inria(&gaussians, &["SplatRenderMode: mip".to_owned(), "two\nlines".to_owned()], &path).unwrap();
        let ply = Ply::open(&path).unwrap();
        assert_eq!(ply.comments(), ["SplatRenderMode: mip", "two lines"]);
        let back = all(&ply);
        for column in Attributes::all().iter() {
            assert_eq!(
                bits(back.attribute_values(column)),
                bits(gaussians.attribute_values(column)),
                "{degree} {}",
                column.name()
            );
        }
        if degree == 3 {
            assert_eq!(ply.row(0).len(), 248);
        }
    }
    write_inria(&Gaussians::zeros(0, 2), &[], &temp.path("empty.ply")).unwrap();
    assert_eq!(Ply::open(&temp.path("empty.ply")).unwrap().count(), 0);
    assert!(write_inria(&Gaussians::default(), &[], &temp.path("no_sh.ply")).is_err());
}
