//! Opening of input files. Only regular files are opened.
//!
//! Opening a named pipe waits until another program writes to it, a device such as `/dev/zero` never ends, and reading
//! a device may have side effects. Every reader of a file that a user names opens it with [`open_file`].

use std::fs::{self, File, FileType};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use splat_platform::{FileKind, open_without_waiting};

use crate::error::{Error, Result};

/// Opens the regular file at `path` for reading. `path` may be a link to a regular file.
///
/// # Errors
/// Fails if nothing exists at `path`. Also fails for folders, named pipes, sockets and devices, without opening them.
pub(crate) fn open_file(path: &Path) -> Result<File> {
    // Check the kind of file before opening, because opening a device may have side effects, and again afterwards,
    // because the file may have been replaced meanwhile.
    check_regular(path, fs::metadata(path).map_err(Error::io("open", path))?.file_type())?;
    // Open without waiting, in case a named pipe has replaced the file since the check.
    let file = open_without_waiting(path).map_err(Error::io("open", path))?;
    check_regular(path, file.metadata().map_err(Error::io("open", path))?.file_type())?;
    Ok(file)
}

/// Reads the whole file at `path`, which must be regular and hold at most `most_bytes`. `what` names its content in
/// messages, as in "a configuration".
///
/// # Errors
/// Fails like [`open_file`], if the file is larger than `most_bytes` (it is then not read), or if reading fails.
pub(crate) fn read_small(path: &Path, most_bytes: u64, what: &str) -> Result<Vec<u8>> {
    let file = open_file(path)?;
    let length = file.metadata().map_err(Error::io("read the size of", path))?.len();
    let larger = |found: String| {
        Error::input(path, "", format!("{what} of at most {most_bytes} bytes"), found)
            .hint("check that the path is the intended one")
    };
    if length > most_bytes {
        return Err(larger(format!("{length} bytes")));
    }
    let mut bytes = Vec::with_capacity(length as usize);
    // Read at most one byte more than allowed: some file systems report a length of 0 for files with content, and the
    // file may grow.
    file.take(most_bytes.saturating_add(1)).read_to_end(&mut bytes).map_err(Error::io("read", path))?;
    if bytes.len() as u64 > most_bytes {
        return Err(larger("more".to_owned()));
    }
    Ok(bytes)
}

/// Returns the paths of the entries of `folder`, sorted, because the file system determines the order of a listing.
///
/// # Errors
/// Fails if the folder cannot be listed.
pub(crate) fn sorted_entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let listed = fs::read_dir(folder).and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect());
    let mut paths: Vec<PathBuf> = listed.map_err(Error::io("list", folder))?;
    paths.sort();
    Ok(paths)
}

/// Checks that `file_type`, the type of the file at `path`, is that of a regular file. The error names the type found.
fn check_regular(path: &Path, file_type: FileType) -> Result<()> {
    let kind = match FileKind::from_type(file_type) {
        FileKind::File => return Ok(()),
        FileKind::Folder => return Err(Error::io("open", path)(io::ErrorKind::IsADirectory.into())),
        FileKind::Fifo => "a named pipe",
        FileKind::Socket => "a socket",
        FileKind::CharacterDevice | FileKind::BlockDevice => "a device",
        FileKind::Link | FileKind::Other => "another kind of file",
    };
    Err(Error::input(path, "", "a regular file", kind)
        .hint("copy its content into a file and give that; a frame stream is read from standard input, given as -"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn larger_files_are_refused_before_they_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        fs::write(&path, b"12345").unwrap();
        assert_eq!(read_small(&path, 5, "a configuration").unwrap(), b"12345");
        let message = read_small(&path, 4, "a configuration").unwrap_err().to_string();
        assert!(message.contains("a configuration of at most 4 bytes, found 5 bytes"), "{message}");
    }

    #[cfg(unix)]
    #[test]
    fn devices_sockets_pipes_and_folders_are_refused_by_kind() {
        let folder = tempfile::tempdir().unwrap();
        let socket = folder.path().join("socket");
        let _listener = std::os::unix::net::UnixListener::bind(&socket).unwrap();
        let pipe = folder.path().join("pipe");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status().unwrap();
        assert!(made.success());
        let link = folder.path().join("link");
        std::os::unix::fs::symlink("/dev/zero", &link).unwrap();
        let found = [(&*socket, "found a socket"), (&pipe, "found a named pipe"), (&link, "found a device")];
        for (path, expected) in found.into_iter().chain([(folder.path(), "directory")]) {
            let message = open_file(path).unwrap_err().to_string();
            assert!(message.contains(expected), "{expected:?} is not in {message:?}");
        }
    }
}
