//! JSON values of limited size. A file may hold values of any size, but only as much of a value is kept in memory as a
//! camera file can need.

use std::fmt;

use serde::Deserialize;
use serde::de::{DeserializeSeed, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Number, Value};

/// Maximum length in bytes of a JSON string that is kept in memory; no system has longer paths.
const MAX_TEXT: usize = 4096;
/// Maximum length in bytes of a key of a JSON object; of a longer key, only the beginning is kept in memory.
const MAX_KEY: usize = 64;
/// Maximum number of keys of a JSON object that are kept in memory, not counting the wanted keys (those that the reader
/// asked for).
const MAX_KEYS: usize = 8;
/// Maximum number of elements of a JSON list that are kept in memory, unless the caller asks for fewer.
pub(crate) const MAX_ELEMENTS: usize = 16;
/// Maximum number of values that are kept in memory for one entry of the outermost JSON object. Nested values count,
/// too: a 4 × 4 matrix takes 21 (itself, 4 rows and 16 numbers).
const MAX_VALUES: usize = 64;

/// JSON value of limited size. Values that are too large are replaced by [`SmallValue::Large`], and a list keeps only
/// its first elements.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum SmallValue {
    Null,
    Bool(bool),
    Number(Number),
    Text(Box<str>),
    /// First elements of a list, and the number of all its elements.
    List(Vec<SmallValue>, usize),
    Object(Object),
    /// Description, for messages, of a value that is not kept. Such a value is longer or has more parts than any value
    /// in a camera file, or has a type that the reader does not expect.
    Large(Box<str>),
}

/// Entries of a JSON object that are kept: those with requested keys (keys that the reader asked for), and a few others
/// for messages. `other_key_count` is the number of the latter.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Object {
    entries: Vec<(Box<str>, SmallValue)>,
    other_key_count: usize,
}

impl Object {
    /// Returns the value under `key`, or the last such value if the key is repeated; `None` without such a key.
    pub(crate) fn get(&self, key: &str) -> Option<&SmallValue> {
        self.entries.iter().find(|(name, _)| **name == *key).map(|(_, value)| value)
    }

    /// Sets the value under `key`, replacing an earlier value.
    fn set(&mut self, key: &str, value: SmallValue) {
        match self.entries.iter_mut().find(|(name, _)| **name == *key) {
            Some(entry) => entry.1 = value,
            None => self.entries.push((key.into(), value)),
        }
    }
}

impl SmallValue {
    /// Builds a JSON object with the single entry `key`: `value`.
    pub(crate) fn from_entry(key: &str, value: SmallValue) -> SmallValue {
        SmallValue::Object(Object { entries: vec![(key.into(), value)], other_key_count: 0 })
    }

    /// Returns the elements if this is a list of which every element is in memory; `None` for a list that was cut to
    /// its first elements, and for other values.
    pub(crate) fn elements(&self) -> Option<&[SmallValue]> {
        match self {
            SmallValue::List(kept, total) if kept.len() == *total => Some(kept),
            _ => None,
        }
    }

    /// Returns the nearest f64 if the value is a number; `None` for other values.
    pub(crate) fn as_f64(&self) -> Option<f64> {
        match self {
            SmallValue::Number(number) => number.as_f64(),
            _ => None,
        }
    }

    /// Returns the value as u64 if it is a non-negative integer; `None` for other values.
    pub(crate) fn as_u64(&self) -> Option<u64> {
        match self {
            SmallValue::Number(number) => number.as_u64(),
            _ => None,
        }
    }

    /// Returns the value under `key` if this is an object with this key; otherwise `None`.
    pub(crate) fn get(&self, key: &str) -> Option<&SmallValue> {
        match self {
            SmallValue::Object(object) => object.get(key),
            _ => None,
        }
    }

    /// Returns a description of the value for messages.
    pub(crate) fn describe(&self) -> String {
        const LONGEST: usize = 120;
        match self {
            SmallValue::List(_, 0) => "an empty list".to_owned(),
            SmallValue::List(kept, total) if kept.len() < *total => format!("a list of {total}"),
            SmallValue::Large(what) => what.to_string(),
            SmallValue::Object(object) if object.entries.len() > 4 => {
                let mut keys: Vec<&str> = object.entries.iter().map(|(key, _)| &**key).collect();
                keys.sort_unstable();
                keys.truncate(MAX_KEYS);
                format!("an object with the keys {}", keys.join(", "))
            }
            other => {
                let text = other.value().to_string();
                match text.char_indices().nth(LONGEST) {
                    Some((end, _)) => format!("{}…", &text[..end]),
                    None => text,
                }
            }
        }
    }

    /// Converts the value to a `serde_json` value. A list that was cut when it was read holds only its first elements.
    fn value(&self) -> Value {
        match self {
            SmallValue::Null => Value::Null,
            SmallValue::Bool(value) => Value::Bool(*value),
            SmallValue::Number(number) => Value::Number(number.clone()),
            SmallValue::Text(text) => Value::String(text.to_string()),
            SmallValue::List(kept, _) => Value::Array(kept.iter().map(SmallValue::value).collect()),
            SmallValue::Object(object) => {
                let entries = object.entries.iter().map(|(key, value)| (key.to_string(), value.value()));
                Value::Object(entries.collect::<Map<_, _>>())
            }
            SmallValue::Large(what) => Value::String(format!("({what})")),
        }
    }
}

/// Deserializer (serde seed) that reads any JSON value and returns as much of it as the limits allow, as
/// [`SmallValue`].
#[derive(Debug)]
pub(crate) struct Keep<'a> {
    /// Keys that the reader asked for: their values are kept in memory in every object.
    pub(crate) keys: &'a [&'a str],
    /// Maximum number of elements of each list that are kept in memory; the elements after them are only counted.
    pub(crate) elements: usize,
}

impl<'de> DeserializeSeed<'de> for Keep<'_> {
    type Value = SmallValue;

    fn deserialize<D: Deserializer<'de>>(self, from: D) -> Result<SmallValue, D::Error> {
        from.deserialize_any(NestedValue { keep: &self, remaining: &mut MAX_VALUES.clone(), depth: 0 })
    }
}

/// Deserializer (serde seed and visitor) of a JSON value inside the value that [`Keep`] reads. `depth` is its nesting
/// depth, 0 for the outermost value.
struct NestedValue<'a> {
    keep: &'a Keep<'a>,
    /// Number of values, including nested ones, that may still be kept in memory for the entry of the outermost object
    /// that is being read. Starts at 64 ([`MAX_VALUES`]) for every entry.
    remaining: &'a mut usize,
    depth: usize,
}

impl<'a> NestedValue<'a> {
    /// Returns the deserializer of a value that is nested one level deeper.
    fn next_level(&mut self) -> NestedValue<'_> {
        NestedValue { keep: self.keep, remaining: self.remaining, depth: self.depth + 1 }
    }
}

impl<'de> DeserializeSeed<'de> for NestedValue<'_> {
    type Value = SmallValue;

    fn deserialize<D: Deserializer<'de>>(self, from: D) -> Result<SmallValue, D::Error> {
        match self.remaining.checked_sub(1) {
            Some(remaining) => {
                *self.remaining = remaining;
                from.deserialize_any(self)
            }
            None => IgnoredAny::deserialize(from).map(|IgnoredAny| SmallValue::Large("a value of many parts".into())),
        }
    }
}

impl<'de> Visitor<'de> for NestedValue<'_> {
    type Value = SmallValue;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a JSON value")
    }

    fn visit_unit<E>(self) -> Result<SmallValue, E> {
        Ok(SmallValue::Null)
    }

    fn visit_bool<E>(self, value: bool) -> Result<SmallValue, E> {
        Ok(SmallValue::Bool(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<SmallValue, E> {
        Ok(SmallValue::Number(value.into()))
    }

    fn visit_u64<E>(self, value: u64) -> Result<SmallValue, E> {
        Ok(SmallValue::Number(value.into()))
    }

    fn visit_f64<E>(self, value: f64) -> Result<SmallValue, E> {
        Ok(Number::from_f64(value).map_or(SmallValue::Null, SmallValue::Number))
    }

    fn visit_str<E>(self, text: &str) -> Result<SmallValue, E> {
        Ok(match text.len() <= MAX_TEXT {
            true => SmallValue::Text(text.into()),
            false => SmallValue::Large(format!("a text of {} bytes", text.len()).into()),
        })
    }

    fn visit_seq<A: SeqAccess<'de>>(mut self, mut list: A) -> Result<SmallValue, A::Error> {
        let (mut kept, mut total) = (Vec::new(), 0);
        let most = self.keep.elements;
        while kept.len() < most {
            let Some(element) = list.next_element_seed(self.next_level())? else { break };
            kept.push(element);
            total += 1;
        }
        if kept.len() == most {
            while list.next_element::<IgnoredAny>()?.is_some() {
                total += 1;
            }
        }
        Ok(SmallValue::List(kept, total))
    }

    fn visit_map<A: MapAccess<'de>>(mut self, mut map: A) -> Result<SmallValue, A::Error> {
        let mut object = Object::default();
        while let Some(key) = map.next_key_seed(ShortKey)? {
            let is_requested = self.keep.keys.contains(&&*key);
            let is_known = object.get(&key).is_some();
            if !is_requested && !is_known {
                if object.other_key_count == MAX_KEYS {
                    map.next_value::<IgnoredAny>()?;
                    continue;
                }
                object.other_key_count += 1;
            }
            // Give each entry of the document its own limit, so that a large entry cannot displace a wanted one.
            let value = match self.depth {
                0 => {
                    map.next_value_seed(NestedValue { keep: self.keep, remaining: &mut MAX_VALUES.clone(), depth: 1 })?
                }
                _ => map.next_value_seed(self.next_level())?,
            };
            object.set(&key, value);
        }
        Ok(SmallValue::Object(object))
    }
}

/// Deserializer (serde seed) of the key of an object. Returns the key. If the key is longer than 64 bytes
/// ([`MAX_KEY`]), returns its beginning followed by "…".
#[derive(Debug)]
pub(crate) struct ShortKey;

impl<'de> DeserializeSeed<'de> for ShortKey {
    type Value = String;

    fn deserialize<D: Deserializer<'de>>(self, from: D) -> Result<String, D::Error> {
        from.deserialize_str(self)
    }
}

impl Visitor<'_> for ShortKey {
    type Value = String;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a key")
    }

    fn visit_str<E>(self, key: &str) -> Result<String, E> {
        let end = (0..=key.len().min(MAX_KEY)).rev().find(|&end| key.is_char_boundary(end)).unwrap_or(0);
        // Append "…" to a key that was cut, so that it does not equal a wanted key.
        Ok(if end < key.len() { format!("{}…", &key[..end]) } else { key.to_owned() })
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::super::{ParseAbort, read_from};
    use super::*;

    fn kept(text: &str) -> SmallValue {
        let keep = Keep { keys: &["frames", "w2c"], elements: MAX_ELEMENTS };
        read_from(text.as_bytes(), Path::new("a"), &ParseAbort::default(), keep).unwrap()
    }

    #[test]
    fn small_values_are_kept_whole() {
        for text in ["null", "[1,-2,2.5,\"é\",[[true]],{\"a\":{\"b\":[]}}]", "{\"a\":1}", "18446744073709551615"] {
            assert_eq!(kept(text).value(), serde_json::from_str::<Value>(text).unwrap());
        }
        assert_eq!(kept("[]").describe(), "an empty list");
        assert_eq!(kept("{\"a\": [1, 2]}").describe(), "{\"a\":[1,2]}");
        assert_eq!(kept("{\"a\": 1, \"a\": 2}").get("a").unwrap().as_u64(), Some(2));
    }

    #[test]
    fn large_values_are_described_and_not_kept() {
        let many = format!("[{}0]", "0,".repeat(99_999));
        assert_eq!(kept(&many).describe(), "a list of 100000");
        assert_eq!(kept(&many).elements(), None);
        let nested = format!("[{}0]", "[[1,2],[3,4]],".repeat(15));
        let SmallValue::List(elements, 16) = kept(&nested) else { panic!("a list of 16") };
        assert!(elements.contains(&SmallValue::Large("a value of many parts".into())));
        assert_eq!(kept(&format!("\"{}\"", "x".repeat(5000))).describe(), "a text of 5000 bytes");
        let keys: Vec<String> = (0..1000).map(|k| format!("\"k{k}\": [1, 2, 3]")).collect();
        let object = kept(&format!("{{{}, \"w2c\": 7}}", keys.join(", ")));
        assert_eq!(object.get("w2c").and_then(SmallValue::as_u64), Some(7), "a wanted key behind many others");
        assert!(object.describe().starts_with("an object with the keys k0, k1"));
        let long = kept(&format!("{{\"{}\": 1}}", "k".repeat(1000)));
        assert!(long.describe().len() < 100, "{long:?}");
    }
}
