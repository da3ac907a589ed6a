//! The parts of an archive beside symbols, by name, and the PLY among them.

use std::io::{self, Write};
use std::path::Path;

use crate::archive::Content;
use crate::error::{Error, Result};
use crate::files::ply::write::{beside, bytes_beside, write_rows};
use crate::files::ply::{Ply, PlyHeader, name_without_bands};

/// Names of what an archive holds of a PLY beside its rows.
pub(crate) const HEADER: &str = "ply.header";
const LEAD: &str = "ply.lead";
const TAIL: &str = "ply.tail";
/// Name of a model folder's configuration in an archive; without one it is a single PLY.
pub(crate) const CFG_ARGS: &str = "cfg_args";
/// Name of the number of a model folder's training iteration, as text.
pub(crate) const ITERATION: &str = "iteration";

/// Adds what is left of `template` beside the attributes: of `rows` what else they have, and what is around them.
///
/// # Errors
/// A template cut short since it was opened.
pub(crate) fn add_cloud(content: &mut Content, template: &Ply, rows: impl Iterator<Item = u32>) -> Result<()> {
    template.check_unshrunk()?;
    let [lead, tail] = template.bytes_around();
    let what = "what the archive keeps beside the attributes of Gaussians";
    let bytes = lead + tail + bytes_beside(template) * content.cloud.len();
    // The content, and the archive that it is encoded to.
    template.memory().check(template.path(), "element vertex", what, 2 * bytes as u64)?;
    content.beside = beside(template, rows);
    let around = |write: &dyn Fn(&mut dyn Write) -> io::Result<()>| {
        let mut bytes = Vec::new();
        write(&mut bytes).map(|()| bytes).map_err(Error::io("read", template.path()))
    };
    let lead = around(&|out| template.write_lead(out))?;
    let tail = around(&|out| template.write_tail(out))?;
    let name = |name: &str| name_without_bands(name, template.sh_degree(), content.cloud.sh_degree());
    let header = template.header().text_for(content.cloud.len(), name);
    for (name, bytes) in [(HEADER, header), (LEAD, lead), (TAIL, tail)] {
        content.files.insert(name.to_owned(), bytes);
    }
    Ok(())
}

/// Writes the PLY of an archive, read from `path`, to `to`.
pub(super) fn write_cloud(content: &Content, path: &Path, to: &Path) -> Result<()> {
    let part = |name: &str| {
        let missing = || Error::input(path, "blobs", format!("a part named {name}"), "none");
        content.files.get(name).ok_or_else(missing)
    };
    let header = PlyHeader::parse(path, part(HEADER)?)?;
    write_rows(path, &header, [part(LEAD)?, part(TAIL)?], &content.beside, &content.cloud, to)
}
