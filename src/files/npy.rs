//! What has to be checked of a NumPy array before a reader believes its header.

/// Longest header. Those of arrays of numbers have 118 bytes, or 54 more for every axis.
const LONGEST: u64 = 4096;
/// Bytes of a file that hold its header, if that is not too long.
pub(crate) const HEAD: u64 = LONGEST + 12;
/// Most digits of a shape: the product of its lengths stays below 2⁶³.
const MOST_DIGITS: usize = 18;
/// Deepest brackets: a shape within the dictionary, and one more.
const DEEPEST: usize = 3;

/// Whether a file of `bytes`, which begins with `head` ([`HEAD`] of them or all), has a header that a reader can be given: it
/// makes room for the length that is announced, up to 4 GiB, before it looks, its time doubles with every open bracket, and
/// it multiplies the lengths of a shape whatever they are.
pub(crate) fn header_is_sound(head: &[u8], bytes: u64) -> bool {
    let start = if head.get(6) == Some(&1) { 10 } else { 12 };
    let Some(digits) = head.get(8..start) else { return false };
    let length = digits.iter().rev().fold(0, |sum, &digit| sum << 8 | u64::from(digit));
    if length > LONGEST || start as u64 + length > bytes {
        return false;
    }
    let Some(text) = head.get(start..start + length as usize) else { return false };
    let mut depth = 0usize;
    digits_of_shape(text) <= MOST_DIGITS
        && text.iter().all(|byte| {
            match byte {
                b'{' | b'[' | b'(' => depth += 1,
                b'}' | b']' | b')' => depth = depth.saturating_sub(1),
                _ => {}
            }
            depth <= DEEPEST
        })
}

/// Digits of the first tuple of lengths; a header without one has none.
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
    fn a_header_longer_than_its_file_or_than_any_is_not_sound() {
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
    fn lengths_whose_product_overflows_are_not_sound() {
        let sound = |shape: &str| {
            let text = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}");
            header_is_sound(&file(1, text.len() as u32, &text), 1000)
        };
        assert!(sound("(300, 1000000, 4)") && sound("()"));
        assert!(!sound("(9999999999, 9999999999)") && !sound("(1000000000, 1000000, 1000000)"));
    }

    #[test]
    fn brackets_deeper_than_an_array_has_are_not_sound() {
        let sound = |text: &str| header_is_sound(&file(1, text.len() as u32, text), 1000);
        assert!(sound("{'descr': [('x', '<f4'), ('y', '<f4')], 'shape': (1,)}"));
        assert!(!sound("{{[[") && !sound("]]]]{{{{"));
    }
}
