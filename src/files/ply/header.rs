//! Parses the header of a PLY file: encoding, elements, properties, comments.
//!
//! Input: the bytes of a file. Output: [`PlyHeader`]. Source: G. Turk, "The PLY Polygon File Format", 1994.

use std::path::Path;

use hashbrown::HashSet;

use crate::error::{Error, Result, quoted};

/// Maximum length of a PLY header in bytes: enough for about 50,000 properties. Gaussian models have 60 to a few
/// hundred properties.
const MAX_HEADER_BYTES: usize = 1 << 20;

/// Encoding of the numbers after the header of a PLY file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlyEncoding {
    /// Text, one row per line.
    Ascii,
    /// Little-endian binary.
    LittleEndian,
    /// Big-endian binary.
    BigEndian,
}

impl PlyEncoding {
    /// Names of all encodings of a PLY file, for messages.
    const NAMES: &str = "ascii, binary_little_endian or binary_big_endian";

    /// Returns the encoding that the `format` line of a header calls `name`; `None` for other names.
    fn parse(name: &str) -> Option<PlyEncoding> {
        match name {
            "ascii" => Some(PlyEncoding::Ascii),
            "binary_little_endian" => Some(PlyEncoding::LittleEndian),
            "binary_big_endian" => Some(PlyEncoding::BigEndian),
            _ => None,
        }
    }
}

/// Number type of a PLY property.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[expect(missing_docs, reason = "the names say it")]
pub enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    /// Returns the type that a header calls `name`, in the old (`float`) or the sized (`float32`) spelling; `None` for
    /// other names.
    fn parse(name: &str) -> Option<Scalar> {
        Some(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return None,
        })
    }

    /// Returns the name of the type in the old spelling, such as `float`.
    pub fn name(self) -> &'static str {
        match self {
            Scalar::I8 => "char",
            Scalar::U8 => "uchar",
            Scalar::I16 => "short",
            Scalar::U16 => "ushort",
            Scalar::I32 => "int",
            Scalar::U32 => "uint",
            Scalar::F32 => "float",
            Scalar::F64 => "double",
        }
    }

    /// Returns the number of bytes of one value in a binary file.
    pub fn bytes(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }
}

/// Property of a PLY element: one column of the element's table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Property {
    /// Name of the property in the header.
    pub name: String,
    /// Number type of the values of the property.
    pub scalar: Scalar,
    /// Offset in bytes of the value in a binary row.
    pub offset: usize,
}

/// Element of a PLY file: a table of `count` rows. Each row has one value per property.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Element {
    pub(crate) name: String,
    pub(crate) count: u64,
    pub(crate) properties: Vec<Property>,
    /// Length of a binary row in bytes. Has a meaning only if the element has no list properties.
    pub(crate) stride: usize,
    /// Whether the element has list properties, so that its rows have no fixed size.
    has_lists: bool,
}

/// Parsed header of a PLY file. The rows of every listed element have a fixed size.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct PlyHeader {
    pub(crate) encoding: PlyEncoding,
    pub(crate) elements: Vec<Element>,
    /// Names of the elements that are not read: elements with a list property, and all elements after a list element
    /// that has rows.
    pub(crate) skipped: Vec<String>,
    /// Texts of the `comment` lines of the header, in order.
    pub(crate) comments: Vec<String>,
    /// Bytes of the header, up to and including the line end of `end_header`.
    pub(crate) text: Vec<u8>,
    /// Number of lines of the header.
    pub(crate) lines: usize,
}

impl PlyHeader {
    /// Parses the header at the start of `bytes`, the content of the file at `path`. Lines may end in LF or CRLF.
    ///
    /// # Errors
    /// Fails if the file is not a PLY, if the header has no `end_header` or more than 1 MiB, if a line, type or count
    /// is invalid, or if a name is used twice. Also fails if the rows of Gaussians or rows before them have list
    /// properties, because such rows have no fixed size. The error names the line.
    pub(crate) fn parse(path: &Path, bytes: &[u8]) -> Result<PlyHeader> {
        let (length, bytes) = (bytes.len(), &bytes[..bytes.len().min(MAX_HEADER_BYTES)]);
        let first = bytes.split(|&b| b == b'\n').next().unwrap_or_default();
        if first.trim_ascii_end() != b"ply" {
            return Err(Error::input(path, "first line", "\"ply\"", found(first)).hint("this is not a PLY file"));
        }
        let mut encoding = None;
        let mut elements: Vec<Element> = Vec::new();
        let mut comments = Vec::new();
        let mut element_names: HashSet<&[u8]> = HashSet::new();
        let mut property_names: HashSet<&[u8]> = HashSet::new();
        let mut end = 0;
        for (index, raw) in bytes.split_inclusive(|&b| b == b'\n').enumerate() {
            end += raw.len();
            let place = || format!("header line {}", index + 1);
            let text = String::from_utf8_lossy(excerpt(raw));
            if index == 0 {
                continue;
            }
            if !raw.ends_with(b"\n") {
                break;
            }
            let words: Vec<&str> = text.split_ascii_whitespace().collect();
            match words[..] {
                [] | ["obj_info", ..] => {}
                ["comment", ..] => {
                    let all = raw.trim_ascii();
                    let comment = all.strip_prefix(b"comment").unwrap_or(all).trim_ascii_start();
                    comments.push(String::from_utf8_lossy(comment).into_owned());
                }
                ["format", name, "1.0"] => {
                    let unknown = || Error::input(path, place(), PlyEncoding::NAMES, quoted(name));
                    encoding = Some(PlyEncoding::parse(name).ok_or_else(unknown)?);
                }
                ["element", name, count] => {
                    if !element_names.insert(word(raw, 1)) {
                        return Err(Error::input(
                            path,
                            place(),
                            "elements of different names",
                            format!("{} twice", quoted(name)),
                        ));
                    }
                    let count = count.parse().map_err(|_| Error::input(path, place(), "a row count", quoted(count)))?;
                    property_names.clear();
                    elements.push(Element {
                        name: name.to_owned(),
                        count,
                        properties: Vec::new(),
                        stride: 0,
                        has_lists: false,
                    });
                }
                ["property", "list", .., name] => {
                    check_list(path, place, &elements, name)?;
                    elements.iter_mut().last().into_iter().for_each(|element| element.has_lists = true);
                }
                ["property", kind, name] => {
                    let Some(scalar) = Scalar::parse(kind) else {
                        return Err(Error::input(path, place(), "a number type of PLY, such as float", quoted(kind)));
                    };
                    let Some(element) = elements.last_mut() else {
                        return Err(Error::input(path, place(), "an element before its properties", found(raw)));
                    };
                    if !property_names.insert(word(raw, 2)) {
                        let expected = format!("each property of element {} once", quoted(&element.name));
                        return Err(Error::input(path, place(), expected, format!("{} twice", quoted(name))));
                    }
                    element.properties.push(Property { name: name.to_owned(), scalar, offset: element.stride });
                    element.stride += scalar.bytes();
                }
                ["end_header"] => {
                    let Some(encoding) = encoding else {
                        return Err(Error::input(path, place(), "a format line before it", "none"));
                    };
                    let (elements, skipped) = without_lists(elements);
                    let (text, lines) = (bytes[..end].to_vec(), index + 1);
                    return Ok(PlyHeader { encoding, elements, skipped, comments, text, lines });
                }
                _ => {
                    let expected = "a format, comment, element, property or end_header line";
                    return Err(Error::input(path, place(), expected, found(raw)));
                }
            }
        }
        Err(missing_end(path, length))
    }

    /// Returns the bytes of a copy of this header for a file with `count` Gaussians, which differs from this header as
    /// follows:
    ///
    /// - `name` receives the name of each property of the Gaussians and returns its new name, or `None` to remove it.
    /// - Elements that are not read ([`PlyHeader::skipped`]) are left out.
    /// - The encoding `ascii` (text) becomes little-endian binary.
    pub(crate) fn text_for(&self, count: usize, name: impl Fn(&str) -> Option<String>) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.text.len() + 16);
        let (mut in_vertex, mut is_skipped) = (false, false);
        for line in self.text.split_inclusive(|&b| b == b'\n') {
            let text = String::from_utf8_lossy(line);
            let words: Vec<&str> = text.split_ascii_whitespace().collect();
            let line_end: &[u8] = if line.ends_with(b"\r\n") { b"\r\n" } else { b"\n" };
            let changed = match words[..] {
                ["format", ..] if self.encoding == PlyEncoding::Ascii => {
                    Some("format binary_little_endian 1.0".to_owned())
                }
                ["element", element, ..] => {
                    in_vertex = element == "vertex";
                    is_skipped = self.skipped.iter().any(|name| name == element);
                    let differs = self.vertex().is_some_and(|vertex| vertex.count != count as u64);
                    (in_vertex && differs).then(|| format!("element vertex {count}"))
                }
                ["property", kind, old] if in_vertex => match name(old) {
                    None => continue,
                    Some(new) => (new != old).then(|| format!("property {kind} {new}")),
                },
                _ => None,
            };
            match changed {
                _ if is_skipped && !matches!(words[..], ["comment", ..] | ["end_header"]) => (),
                Some(text) => out.extend([text.as_bytes(), line_end].concat()),
                None => out.extend(line),
            }
        }
        out
    }

    /// Returns the element `vertex`, which holds the Gaussians; `None` if the file has no such element.
    pub(crate) fn vertex(&self) -> Option<&Element> {
        self.elements.iter().find(|element| element.name == "vertex")
    }
}

/// Returns the error for a file of `length` bytes without an `end_header` line.
fn missing_end(path: &Path, length: usize) -> Error {
    if length > MAX_HEADER_BYTES {
        let expected = format!("an end_header line within {MAX_HEADER_BYTES} bytes");
        return Error::input(path, "header", expected, format!("none, in a file of {length} bytes"))
            .hint("a header of Gaussians has a few kilobytes: the file is damaged or not a model");
    }
    let what = format!("the file ends after {length} bytes without one");
    Error::input(path, "header", "an end_header line", what).hint("the file is cut short; copy it again")
}

/// Checks that this program can read the Gaussians of a file in which the last element of `elements` has a list
/// property called `name`. Rows with lists have no fixed size. So the element must not be `vertex`, and it must have no
/// rows or come after `vertex`. The error names the file `path` and the position that `place` returns.
fn check_list(path: &Path, place: impl Fn() -> String, elements: &[Element], name: &str) -> Result<()> {
    let is_skippable = |element: &Element, before: &[Element]| {
        element.name != "vertex" && (element.count == 0 || before.iter().any(|element| element.name == "vertex"))
    };
    match elements.split_last() {
        Some((element, before)) if is_skippable(element, before) => Ok(()),
        last => {
            let element = last.map_or("no element", |(element, _)| &element.name);
            let found = format!("list property {} in element {}", quoted(name), quoted(element));
            Err(Error::input(
                path,
                place(),
                "properties of one number, at least up to the end of element vertex",
                found,
            )
            .hint("lists do not occur in Gaussian models; export the points alone"))
        }
    }
}

/// Divides `elements` into elements that can be read, and the names of elements that cannot be read because the offsets
/// of their rows are unknown. The latter are all elements with a list property, and all elements after one that has a
/// list property and at least one row.
fn without_lists(elements: Vec<Element>) -> (Vec<Element>, Vec<String>) {
    let first = elements.iter().position(|element| element.has_lists && element.count > 0).unwrap_or(elements.len());
    let (mut found, mut skipped) = (Vec::new(), Vec::new());
    for (place, element) in elements.into_iter().enumerate() {
        if element.has_lists || place > first { skipped.push(element.name) } else { found.push(element) }
    }
    (found, skipped)
}

/// Returns the word with index `at` of a header line; empty if there are fewer words.
fn word(line: &[u8], at: usize) -> &[u8] {
    excerpt(line).split(u8::is_ascii_whitespace).filter(|word| !word.is_empty()).nth(at).unwrap_or_default()
}

/// Returns at most the first 1024 bytes of a line. This is enough for any keyword of a header with its arguments,
/// whereas a "line" of binary data may be very long.
fn excerpt(line: &[u8]) -> &[u8] {
    &line[..line.len().min(1024)]
}

/// Returns a header line as it is quoted in messages.
fn found(line: &[u8]) -> String {
    let line = line.trim_ascii();
    match line.len() {
        0 => "nothing".to_owned(),
        1..=60 => quoted(&String::from_utf8_lossy(line)),
        _ => format!("{}…", quoted(&String::from_utf8_lossy(&line[..60]))),
    }
}
