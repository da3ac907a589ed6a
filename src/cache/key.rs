//! Cache keys: digests of everything that a result depends on.

use std::io::{self, Write};

use serde::Serialize;
use xxhash_rust::xxh3::Xxh3;

/// Cache key: digest of everything that a result depends on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CacheKey(Option<u128>);

impl CacheKey {
    /// Key of every result in a run without a work folder, in which no results are stored or looked up.
    pub const NONE: CacheKey = CacheKey(None);

    /// Creates the key that is the digest of the bits of `value`.
    pub fn new(value: &impl Serialize) -> CacheKey {
        let mut hash = Hash(Xxh3::new());
        // Every hashed value can be serialized.
        postcard::to_io(value, &mut hash).expect("plain data");
        CacheKey(Some(hash.0.digest128()))
    }

    /// Returns the key of a result that depends on `value` in addition to everything that this key stands for.
    pub fn extended_by(self, value: &impl Serialize) -> CacheKey {
        self.0.map_or(CacheKey::NONE, |before| CacheKey::new(&(before, CacheKey::new(value))))
    }

    /// Returns the key as 32 hexadecimal digits.
    pub(super) fn text(self) -> String {
        format!("{:032x}", self.0.unwrap_or_default())
    }
}

impl Serialize for CacheKey {
    fn serialize<S: serde::Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        self.0.serialize(to)
    }
}

/// Writer that hashes the bytes written to it.
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
