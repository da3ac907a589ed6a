//! Archive parts (byte strings of a `.gsz`, each with a name) that are stored without entropy coding. Functions here
//! store the bytes of a PLY file that belong to no attribute of a Gaussian, write the PLY file of an archive, and
//! remove the folders of the training machine from YAML texts.

use std::io::{self, Write};
use std::path::Path;

use crate::archive::ArchiveContent;
use crate::error::{Error, Result};
use crate::files::names::last_component;
use crate::files::ply::write::{extra_bytes_per_row, extra_property_bytes, write_rows};
use crate::files::ply::{Ply, PlyHeader, name_at_sh_degree};

/// Name of the archive part with the header of the PLY file.
pub(crate) const HEADER: &str = "ply.header";
/// Name of the archive part with the bytes of the PLY file between the header and the rows of the Gaussians.
const LEAD: &str = "ply.lead";
/// Name of the archive part with the bytes of the PLY file after the rows of the Gaussians.
const TAIL: &str = "ply.tail";
/// Name of the archive part with the configuration (`cfg_args`) of a model folder. An archive without this part holds a
/// single PLY.
pub(crate) const CFG_ARGS: &str = "cfg_args";
/// Name of the archive part with the training iteration of a model folder, as text.
pub(crate) const ITERATION: &str = "iteration";

/// Adds to `content` all data of the PLY file `template` that are not attributes: the extra properties of the Gaussians
/// in the rows `rows` of the file, and the bytes of the file before and after the rows of Gaussians.
///
/// # Errors
/// Fails if the template was cut short since it was opened, or if its data need more memory than allowed.
pub(crate) fn add_cloud(content: &mut ArchiveContent, template: &Ply, rows: impl Iterator<Item = u32>) -> Result<()> {
    template.check_unshrunk()?;
    let [lead, tail] = template.bytes_around();
    let what = "the data that the archive keeps beside the attributes of Gaussians";
    let bytes = lead + tail + extra_bytes_per_row(template) * content.cloud.len();
    // Counted twice: for the content and for the archive encoded from it.
    template.memory().check(template.path(), "element vertex", what, 2 * bytes as u64)?;
    content.extra_bytes = extra_property_bytes(template, rows);
    let around = |write: &dyn Fn(&mut dyn Write) -> io::Result<()>| {
        let mut bytes = Vec::new();
        write(&mut bytes).map(|()| bytes).map_err(Error::io("read", template.path()))
    };
    let lead = around(&|out| template.write_lead(out))?;
    let tail = around(&|out| template.write_tail(out))?;
    let name = |name: &str| name_at_sh_degree(name, template.layout().stored_degree, content.cloud.sh_degree());
    let header = template.header().text_for(content.cloud.len(), name);
    for (name, bytes) in [(HEADER, header), (LEAD, lead), (TAIL, tail)] {
        content.files.insert(name.to_owned(), bytes);
    }
    Ok(())
}

/// Writes the PLY file that `content` describes to the path `to`. `content` was read from the archive at `path`.
pub(super) fn write_cloud(content: &ArchiveContent, path: &Path, to: &Path) -> Result<()> {
    let part = |name: &str| {
        let missing = || Error::input(path, "blobs", format!("a part named {name}"), "none");
        content.files.get(name).ok_or_else(missing)
    };
    let header = PlyHeader::parse(path, part(HEADER)?)?;
    write_rows(path, &header, [part(LEAD)?, part(TAIL)?], &content.extra_bytes, &content.cloud, to)
}

/// Returns the YAML text `text` without the folders of the training machine, because archives are made to be shared.
/// Paths are replaced by their last components: the value of a line `key: value` or `- value`, and every item of a list
/// in brackets. All other bytes are unchanged.
pub(super) fn yaml_without_folders(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for line in text.split_inclusive('\n') {
        let start = [": ", "- "].iter().filter_map(|mark| line.find(mark)).min().map_or(0, |at| at + 2);
        let (key, value) = line.split_at(start);
        out += key;
        let is_list = value.trim_start().starts_with(['[', '{']);
        let ends_item = |c: char| matches!(c, '\n' | '\r' | '"' | '\'') || is_list && "[]{}, \t".contains(c);
        let mut rest = value;
        while !rest.is_empty() {
            let end = rest.find(ends_item).unwrap_or(rest.len());
            out += last_component(&rest[..end]);
            let next = rest[end..].chars().next().map_or(end, |c| end + c.len_utf8());
            out += &rest[end..next];
            rest = &rest[next..];
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn yaml_keeps_the_last_names_of_paths() {
        for (before, after) in [
            ("a: 1\nsource_path: \"data/N3V/scene\"\r\n", "a: 1\nsource_path: \"scene\"\r\n"),
            ("  path: /home/My Name/data/\n", "  path: data\n"),
            ("- C:\\Users\\Name\\x.ply", "- x.ply"),
            ("scenes: [/a/b, 'c/d', 1.5]\n", "scenes: [b, 'd', 1.5]\n"),
            ("rate: 0.5\n\n# text\n", "rate: 0.5\n\n# text\n"),
            ("/only/a/path", "path"),
            ("", ""),
        ] {
            assert_eq!(yaml_without_folders(before), after);
        }
    }
}
