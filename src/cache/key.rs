//! Digests of all that a result follows from.

use std::io::{self, Write};

use serde::Serialize;
use xxhash_rust::xxh3::Xxh3;

/// The digest of everything that a result follows from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CacheKey(Option<u128>);

impl CacheKey {
    /// Of whatever: nothing is looked up under it.
    pub const NONE: CacheKey = CacheKey(None);

    /// Of `value`, by its bits.
    pub fn new(value: &impl Serialize) -> CacheKey {
        let mut hash = Hash(Xxh3::new());
        // Nothing that is hashed here has a part that cannot be written down.
        postcard::to_io(value, &mut hash).expect("plain data");
        CacheKey(Some(hash.0.digest128()))
    }

    /// Of what this stands for, and `value`.
    pub fn and(self, value: &impl Serialize) -> CacheKey {
        self.0.map_or(CacheKey::NONE, |before| CacheKey::new(&(before, CacheKey::new(value))))
    }

    /// In 32 digits.
    pub(super) fn text(self) -> String {
        format!("{:032x}", self.0.unwrap_or_default())
    }
}

impl Serialize for CacheKey {
    fn serialize<S: serde::Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        self.0.serialize(to)
    }
}

/// Takes bytes in.
struct Hash(Xxh3);

impl Write for Hash {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.update(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
