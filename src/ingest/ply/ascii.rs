//! Text bodies turned into the binary body they stand for, so that one reader serves both.
//!
//! In: header and text. Out: little-endian rows of every element. Memory: the whole body.

use std::path::Path;

use super::header::{Element, Header, Property, Scalar};
use crate::error::{Error, Result, quoted};

/// The body as little-endian rows. One row per line; blank lines are skipped; what follows the last
/// row is ignored.
///
/// # Errors
/// Too few rows, a row with too few or too many numbers, a word that is no number of its type; each
/// names the line.
pub(super) fn to_binary(path: &Path, header: &Header, body: &[u8]) -> Result<Vec<u8>> {
    let mut size = 0;
    for element in &header.elements {
        // A number takes a digit and a separator, which bounds the rows before anything is allocated.
        let least = element.count.checked_mul(2 * element.properties.len() as u64);
        if least.is_none_or(|least| least > body.len() as u64 + 1) {
            let expected = format!("{} rows of {} numbers", element.count, element.properties.len());
            return Err(Error::input(path, place(element), expected, format!("{} bytes of text", body.len()))
                .hint("the file is cut short or its header is wrong"));
        }
        size += element.count as usize * element.stride;
    }
    let mut binary = Vec::with_capacity(size);
    let mut lines = body
        .split(|&b| b == b'\n')
        .map(<[u8]>::trim_ascii)
        .zip(header.lines + 1..)
        .filter(|(line, _)| !line.is_empty());
    for element in header.elements.iter().filter(|element| !element.properties.is_empty()) {
        for row in 0..element.count {
            let Some((line, number)) = lines.next() else {
                return Err(Error::input(
                    path,
                    place(element),
                    format!("{} rows", element.count),
                    format!("{row} rows"),
                )
                .hint("the file is cut short; copy it again"));
            };
            let words = || line.split(u8::is_ascii_whitespace).filter(|word| !word.is_empty());
            if words().count() != element.properties.len() {
                let expected = format!("{} numbers, as {} declares", element.properties.len(), place(element));
                return Err(Error::input(path, format!("line {number}"), expected, words().count().to_string()));
            }
            for (word, property) in words().zip(&element.properties) {
                push_number(&mut binary, word, property.scalar)
                    .ok_or_else(|| unreadable(path, number, property, word))?;
            }
        }
    }
    Ok(binary)
}

fn place(element: &Element) -> String {
    format!("element {}", element.name)
}

fn unreadable(path: &Path, line: usize, property: &Property, word: &[u8]) -> Error {
    let expected = format!("a number of type {} for property {}", property.scalar.name(), quoted(&property.name));
    let word = String::from_utf8_lossy(&word[..word.len().min(60)]);
    Error::input(path, format!("line {line}"), expected, quoted(&word))
}

/// Appends the number `word` stands for; `None` when it stands for none of that type.
fn push_number(out: &mut Vec<u8>, word: &[u8], scalar: Scalar) -> Option<()> {
    let word = std::str::from_utf8(word).ok()?;
    match scalar {
        Scalar::I8 => out.extend(word.parse::<i8>().ok()?.to_le_bytes()),
        Scalar::U8 => out.extend(word.parse::<u8>().ok()?.to_le_bytes()),
        Scalar::I16 => out.extend(word.parse::<i16>().ok()?.to_le_bytes()),
        Scalar::U16 => out.extend(word.parse::<u16>().ok()?.to_le_bytes()),
        Scalar::I32 => out.extend(word.parse::<i32>().ok()?.to_le_bytes()),
        Scalar::U32 => out.extend(word.parse::<u32>().ok()?.to_le_bytes()),
        Scalar::F32 => out.extend(word.parse::<f32>().ok()?.to_le_bytes()),
        Scalar::F64 => out.extend(word.parse::<f64>().ok()?.to_le_bytes()),
    }
    Some(())
}
