//! Checks the header of a NumPy array file, which may be malicious, before the header is given to the parser of another
//! crate.

/// Maximum length in bytes of the header of a NumPy array file. The header of an array of numbers usually has 118
/// bytes, and at most 54 more for every axis.
const MAX_HEADER_BYTES: u64 = 4096;
/// Number of bytes to read from the start of a NumPy array file for checking its header: the maximum length of the
/// header, and 12 bytes for the magic, the version and the length before it.
pub(crate) const HEAD: u64 = MAX_HEADER_BYTES + 12;
/// Maximum number of digits in the shape of an array, all axes together. The number of elements is then below 2⁶³.
const MAX_SHAPE_DIGITS: usize = 18;
/// Maximum nesting depth of brackets in the header of a NumPy array file: the dictionary, the shape in it, and one more
/// level.
const MAX_BRACKET_DEPTH: usize = 3;

/// Returns whether the header of a NumPy array file may be given to the parser. `head` holds the first [`HEAD`] bytes
/// of the file, or all of them if the file is shorter; `bytes` is the length of the file. The conditions are:
///
/// - The file holds the whole header.
/// - The length of the header, the number of digits in its shape and the nesting depth of its brackets do not exceed
///   their limits.
///
/// The parser itself is unsafe for forged headers. It allocates the declared header length (up to 4 GiB) before
/// reading, its time doubles with every open bracket, and it multiplies the lengths of a shape without a check for
/// overflow.
pub(crate) fn header_is_sound(head: &[u8], bytes: u64) -> bool {
    let start = if head.get(6) == Some(&1) { 10 } else { 12 };
    let Some(digits) = head.get(8..start) else { return false };
    let length = digits.iter().rev().fold(0, |sum, &digit| sum << 8 | u64::from(digit));
    if length > MAX_HEADER_BYTES || start as u64 + length > bytes {
        return false;
    }
    let Some(text) = head.get(start..start + length as usize) else { return false };
    let mut depth = 0usize;
    digits_of_shape(text) <= MAX_SHAPE_DIGITS
        && text.iter().all(|byte| {
            match byte {
                b'{' | b'[' | b'(' => depth += 1,
                b'}' | b']' | b')' => depth = depth.saturating_sub(1),
                _ => {}
            }
            depth <= MAX_BRACKET_DEPTH
        })
}

/// Returns the number of digits in the shape that the header `text` states; 0 if it states none.
fn digits_of_shape(text: &[u8]) -> usize {
    const KEY: &[u8] = b"'shape'";
    let Some(at) = text.windows(KEY.len()).position(|some| some == KEY) else { return 0 };
    let shape = text[at..].split(|&byte| byte == b')').next().unwrap_or_default();
    shape.iter().filter(|byte| byte.is_ascii_digit()).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(version: u8, length: u32, text: &str) -> Vec<u8> {
        let mut file = b"\x93NUMPY\0\0".to_vec();
        file[6] = version;
        file.extend(&length.to_le_bytes()[..if version == 1 { 2 } else { 4 }]);
        file.extend(text.as_bytes());
        file
    }

    #[test]
    fn too_long_headers_are_not_sound() {
        let text = "{'descr': '<f8', 'fortran_order': False, 'shape': (1, 17), }";
        for version in [1, 2, 3] {
            let sound = |length: u32| {
                let file = file(version, length, text);
                header_is_sound(&file, file.len() as u64)
            };
            let length = text.len() as u32;
            assert!(sound(length) && !sound(length + 1), "version {version}");
        }
        assert!(!header_is_sound(&file(2, u32::MAX, text), 1 << 40));
        assert!(!header_is_sound(b"\x93NUMPY\x02\0\0\0", 10) && !header_is_sound(b"", 0));
    }

    #[test]
    fn overflowing_shapes_are_not_sound() {
        let sound = |shape: &str| {
            let text = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}");
            header_is_sound(&file(1, text.len() as u32, &text), 1000)
        };
        assert!(sound("(300, 1000000, 4)") && sound("()"));
        assert!(!sound("(9999999999, 9999999999)") && !sound("(1000000000, 1000000, 1000000)"));
    }

    #[test]
    fn deep_brackets_are_not_sound() {
        let sound = |text: &str| header_is_sound(&file(1, text.len() as u32, text), 1000);
        assert!(sound("{'descr': [('x', '<f4'), ('y', '<f4')], 'shape': (1,)}"));
        assert!(!sound("{{[[") && !sound("]]]]{{{{"));
    }
}
