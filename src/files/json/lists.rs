//! Streaming reader of the elements of lists in a JSON document.

use std::fmt;
use std::io::Read;
use std::path::Path;

use serde::de::{DeserializeSeed, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};

use super::small::{Keep, MAX_ELEMENTS, ShortKey, SmallValue};
use super::{ParseAbort, read, read_from};
use crate::error::Result;
use crate::files::open::open_file;

/// Position of a list element in a JSON document.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ElementPosition {
    /// Index in [`ListSelection::keys`] of the key of the list; 0 if the document itself is the list.
    pub(crate) key: usize,
    /// Index of the element in the list. If the key of the list occurs several times in the document, the index starts
    /// at 0 again for each of these lists. As for any repeated key in JSON, only the last of these lists is valid.
    pub(crate) index: usize,
    /// Index of the element in the inner list, if lists of lists are read (see [`ListSelection::nested`]). It is `None`
    /// in these calls:
    ///
    /// - Only the outer list is read: the value is an element of this list.
    /// - The element of the outer list is not a list: the value is this element.
    /// - The call marks the end of an inner list, after the calls for its elements: the value is an empty list.
    pub(crate) inner: Option<usize>,
}

/// Selection of the list elements to read from a JSON document.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ListSelection<'a> {
    /// Keys of the top-level object whose values are the lists; empty if the document itself is the list.
    pub(crate) keys: &'a [&'a str],
    /// Whether the lists are lists of lists. If true, the elements of the inner lists are read, else the elements of
    /// the lists themselves.
    pub(crate) nested: bool,
    /// Keys to keep of an element that is an object. A few other keys are also kept, for error messages.
    pub(crate) element_keys: &'a [&'a str],
}

/// Reads lists in the JSON file at `path`. `selection` names the lists. Calls `each` with the position and the value of
/// every element.
///
/// # Errors
/// Fails if `each` fails, and like [`read`].
pub(crate) fn each_element(
    path: &Path,
    selection: ListSelection<'_>,
    each: impl FnMut(ElementPosition, SmallValue) -> Result<()>,
) -> Result<()> {
    each_element_from(open_file(path)?, path, selection, each)
}

/// Reads lists in the JSON document in the open `file`. `selection` names the lists. Calls `each` with the position and
/// the value of every element. Error messages call the file `path`.
///
/// # Errors
/// Fails if `each` fails, and like [`read`].
pub(crate) fn each_element_from(
    file: impl Read,
    path: &Path,
    selection: ListSelection<'_>,
    mut each: impl FnMut(ElementPosition, SmallValue) -> Result<()>,
) -> Result<()> {
    let stopped = ParseAbort::default();
    let mut lists = Lists { selection, each: &mut each, stopped: &stopped };
    read_from(file, path, &stopped, Document(&mut lists))
}

/// Calls `each` with the key and value of every entry of the JSON object in the file at `path`, in order. Does not call
/// it if the document is not an object. Of each value only the keys in `keys` are kept.
///
/// # Errors
/// Fails if `each` fails, and like [`read`].
pub(crate) fn each_entry(
    path: &Path,
    keys: &[&str],
    mut each: impl FnMut(&str, SmallValue) -> Result<()>,
) -> Result<()> {
    let stopped = ParseAbort::default();
    read(path, &stopped, Entries { keys, each: &mut each, stopped: &stopped })
}

/// State that the serde visitors of a document share while selected lists are read: the `selection` of lists, the
/// callback `each` for the elements, and `stopped`, the slot for an error of the callback.
struct Lists<'a> {
    selection: ListSelection<'a>,
    each: &'a mut dyn FnMut(ElementPosition, SmallValue) -> Result<()>,
    stopped: &'a ParseAbort,
}

/// Defines the methods of a serde visitor that accepts only lists or objects: numbers, texts, booleans and null are
/// ignored without an error.
macro_rules! ignore_scalars {
    () => {
        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("a JSON value")
        }

        fn visit_unit<E>(self) -> std::result::Result<(), E> {
            Ok(())
        }

        fn visit_bool<E>(self, _: bool) -> std::result::Result<(), E> {
            Ok(())
        }

        fn visit_i64<E>(self, _: i64) -> std::result::Result<(), E> {
            Ok(())
        }

        fn visit_u64<E>(self, _: u64) -> std::result::Result<(), E> {
            Ok(())
        }

        fn visit_f64<E>(self, _: f64) -> std::result::Result<(), E> {
            Ok(())
        }

        fn visit_str<E>(self, _: &str) -> std::result::Result<(), E> {
            Ok(())
        }
    };
}

/// Implements [`DeserializeSeed`] (serde's deserializer with state) for the visitor `$type`, which then receives a
/// value of any JSON type.
macro_rules! seed_from_visitor {
    ($type:ty) => {
        impl<'de> DeserializeSeed<'de> for $type {
            type Value = ();

            fn deserialize<D: Deserializer<'de>>(self, from: D) -> std::result::Result<(), D::Error> {
                from.deserialize_any(self)
            }
        }
    };
}

/// Serde visitor of the top-level value of a JSON document. Finds the selected lists in it and visits each with
/// [`List`].
struct Document<'a, 'b>(&'a mut Lists<'b>);
seed_from_visitor!(Document<'_, '_>);

impl<'de> Visitor<'de> for Document<'_, '_> {
    type Value = ();
    ignore_scalars!();

    fn visit_seq<A: SeqAccess<'de>>(self, list: A) -> std::result::Result<(), A::Error> {
        match self.0.selection.keys.is_empty() {
            true => List { lists: self.0, key: 0 }.visit_seq(list),
            false => IgnoredAny.visit_seq(list).map(drop),
        }
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<(), A::Error> {
        while let Some(name) = map.next_key_seed(ShortKey)? {
            match self.0.selection.keys.iter().position(|key| *key == name) {
                Some(key) => map.next_value_seed(List { lists: self.0, key })?,
                None => drop(map.next_value::<IgnoredAny>()?),
            }
        }
        Ok(())
    }
}

/// Serde visitor of one selected list. Passes its elements to the callback `each`. `key` is the index of the list's key
/// in [`ListSelection::keys`].
struct List<'a, 'b> {
    lists: &'a mut Lists<'b>,
    key: usize,
}
seed_from_visitor!(List<'_, '_>);

impl<'de> Visitor<'de> for List<'_, '_> {
    type Value = ();
    ignore_scalars!();

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> std::result::Result<(), A::Error> {
        let Lists { selection, stopped, .. } = *self.lists;
        for index in 0.. {
            let at = ElementPosition { key: self.key, index, inner: None };
            let value = match selection.nested {
                true => list.next_element_seed(InnerList { lists: self.lists, at })?,
                false => list.next_element_seed(Keep { keys: selection.element_keys, elements: MAX_ELEMENTS })?,
            };
            let Some(value) = value else { break };
            (self.lists.each)(at, value).map_err(|error| stopped.by::<A::Error>(error))?;
        }
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> std::result::Result<(), A::Error> {
        IgnoredAny.visit_map(map).map(drop)
    }
}

/// Serde visitor of one element of a list of lists. `at` is the position of the element in the outer list. The result
/// depends on the element:
///
/// - A list: passes each of its elements to the callback `each`, and returns an empty list, because the callback has
///   received all of them.
/// - A text, an object or a number with a fraction: returns a description of it.
/// - Any other value: returns the value itself.
struct InnerList<'a, 'b> {
    lists: &'a mut Lists<'b>,
    at: ElementPosition,
}

impl<'de> DeserializeSeed<'de> for InnerList<'_, '_> {
    type Value = SmallValue;

    fn deserialize<D: Deserializer<'de>>(self, from: D) -> std::result::Result<SmallValue, D::Error> {
        from.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for InnerList<'_, '_> {
    type Value = SmallValue;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a JSON value")
    }

    fn visit_unit<E>(self) -> std::result::Result<SmallValue, E> {
        Ok(SmallValue::Null)
    }

    fn visit_bool<E>(self, value: bool) -> std::result::Result<SmallValue, E> {
        Ok(SmallValue::Bool(value))
    }

    fn visit_i64<E>(self, value: i64) -> std::result::Result<SmallValue, E> {
        Ok(SmallValue::Number(value.into()))
    }

    fn visit_u64<E>(self, value: u64) -> std::result::Result<SmallValue, E> {
        Ok(SmallValue::Number(value.into()))
    }

    fn visit_f64<E>(self, _: f64) -> std::result::Result<SmallValue, E> {
        Ok(SmallValue::Large("a number".into()))
    }

    fn visit_str<E>(self, _: &str) -> std::result::Result<SmallValue, E> {
        Ok(SmallValue::Large("a text".into()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> std::result::Result<SmallValue, A::Error> {
        let Lists { selection, stopped, .. } = *self.lists;
        for inner in 0.. {
            let keep = Keep { keys: selection.element_keys, elements: MAX_ELEMENTS };
            let Some(value) = list.next_element_seed(keep)? else { break };
            let at = ElementPosition { inner: Some(inner), ..self.at };
            (self.lists.each)(at, value).map_err(|error| stopped.by::<A::Error>(error))?;
        }
        Ok(SmallValue::List(Vec::new(), 0))
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> std::result::Result<SmallValue, A::Error> {
        IgnoredAny.visit_map(map).map(|IgnoredAny| SmallValue::Large("an object".into()))
    }
}

/// Serde visitor of a document that should be an object. Passes the key and the value of every entry to the callback
/// `each`. Of a value that is an object, the keys in `keys` are kept. `stopped` is the slot for an error of the
/// callback.
struct Entries<'a> {
    keys: &'a [&'a str],
    each: &'a mut dyn FnMut(&str, SmallValue) -> Result<()>,
    stopped: &'a ParseAbort,
}
seed_from_visitor!(Entries<'_>);

impl<'de> Visitor<'de> for Entries<'_> {
    type Value = ();
    ignore_scalars!();

    fn visit_seq<A: SeqAccess<'de>>(self, list: A) -> std::result::Result<(), A::Error> {
        IgnoredAny.visit_seq(list).map(drop)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<(), A::Error> {
        while let Some(key) = map.next_key_seed(ShortKey)? {
            let value = map.next_value_seed(Keep { keys: self.keys, elements: MAX_ELEMENTS })?;
            (self.each)(&key, value).map_err(|error| self.stopped.by::<A::Error>(error))?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Error;

    fn file(text: &str) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        file
    }

    fn elements(text: &str, keys: &[&str], nested: bool) -> Vec<(usize, usize, Option<usize>, String)> {
        let mut found = Vec::new();
        let selection = ListSelection { keys, nested, element_keys: &[] };
        each_element(file(text).path(), selection, |ElementPosition { key, index, inner }, value| {
            found.push((key, index, inner, value.describe()));
            Ok(())
        })
        .unwrap();
        found
    }

    #[test]
    fn elements_come_in_order_with_their_places() {
        let found = elements("[1, [2], {}]", &[], false);
        assert_eq!(found, [(0, 0, None, "1".into()), (0, 1, None, "[2]".into()), (0, 2, None, "{}".into())]);
        let found = elements("{\"a\": [1], \"c\": [9], \"b\": 3, \"b\": [2], \"a\": [4]}", &["a", "b"], false);
        assert_eq!(found, [(0, 0, None, "1".into()), (1, 0, None, "2".into()), (0, 0, None, "4".into())]);
        let found = elements("{\"a\": [[7, 8], [], 5]}", &["a"], true);
        let empty = || "an empty list".to_owned();
        assert_eq!(
            found,
            [
                (0, 0, Some(0), "7".into()),
                (0, 0, Some(1), "8".into()),
                (0, 0, None, empty()),
                (0, 1, None, empty()),
                (0, 2, None, "5".into())
            ]
        );
    }

    #[test]
    fn error_of_the_callback_ends_reading() {
        let file = file("[1, 2, 3");
        let selection = ListSelection { keys: &[], nested: false, element_keys: &[] };
        let error = each_element(file.path(), selection, |at, _| match at.index {
            1 => Err(Error::usage("enough")),
            _ => Ok(()),
        });
        assert_eq!(error.unwrap_err().to_string(), "enough");
    }
}
