//! Writes a compressed sequence of linked frames (whose Gaussians were matched across frames) as PLY files like those
//! of the input. The file of a frame holds the Gaussians that are present in this frame, and keeps the properties,
//! comments and name of its input file.

use std::path::Path;

use hashbrown::HashSet;
use rayon::prelude::*;

use super::LinkedFrames;
use crate::compressed_model::CompressedModel;
use crate::error::Result;
use crate::files::ply::write::{OutputRow, rows_of_model, write_like_template};
use crate::model::{Attributes, Gaussians};
use crate::models::trajectories::merged;
use crate::progress::Events;
use crate::source::{FrameSource, Ids};

/// Value that stands in place of a row number if a track (Gaussian followed through frames) is absent from a frame.
const NO_ROW: u32 = u32::MAX;

impl LinkedFrames {
    /// Writes one PLY file per frame of the compressed model `compressed` into `folder`. Each Gaussian takes a row of
    /// the input file of the frame:
    /// - A track (Gaussian followed through frames) keeps its row. If it has several Gaussians in the frame, they
    ///   become one, in the row of the first. Attributes that are constant along the track have their mean values.
    /// - A proxy (Gaussian that replaces merged tracks) takes the row of its leader (most important member), or, if the
    ///   leader is absent from the frame, of the first member that is present. If no member is present, the proxy is
    ///   absent too.
    ///
    /// # Errors
    /// Fails if frames cannot be read or a write fails.
    pub(super) fn write_files(&self, compressed: &CompressedModel, folder: &Path, events: &Events) -> Result<()> {
        let (frames, result) = (self.tracks.frames(), merged(self, compressed));
        let all = rows_of_model(compressed);
        let progress = events.task("emit", "frames", frames.paths().len() as u64);
        let write = |&frame: &usize| {
            let mut of_frame = self.tracks.rows(frame, 0..self.tracks.count())?;
            let mut row_of = vec![NO_ROW; self.tracks.count()];
            // If a track has several rows in this frame, use the first.
            of_frame.iter().rev().for_each(|row| row_of[row.track as usize] = row.row);
            let several = of_frame.chunk_by(|a, b| a.track == b.track).filter(|of_track| of_track.len() > 1);
            let blended: HashSet<u32> = several.map(|of_track| of_track[0].track).collect();
            let is_computed = |track: u32| {
                blended.contains(&track) || self.tracks.steady().is_some_and(|steady| steady.has_steady(track))
            };
            let (mut rows, mut written, mut merged, mut computed) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
            for (place, row) in all.iter().enumerate() {
                let members = row.proxy.map_or(&[][..], |proxy| &compressed.clusters[proxy as usize].members[..]);
                let tracks = [row.template_row].into_iter().chain(members.iter().map(|member| member.0));
                if let Some(template_row) = tracks.map(|track| row_of[track as usize]).find(|&row| row != NO_ROW) {
                    if row.proxy.is_some() {
                        merged.push(rows.len());
                    } else if is_computed(row.template_row) {
                        computed.push(rows.len());
                    }
                    rows.push(OutputRow { template_row, proxy: None });
                    written.push(place as u32);
                }
            }
            let template = frames.frame(frame)?;
            let places: Vec<u32> = merged.iter().map(|&at| written[at]).collect();
            let mut first = Gaussians::zeros(0, self.info.sh_degree);
            result.open(Ids::List(&places))?.read(frame, Attributes::all(), &mut first)?;
            of_frame.retain(|row| {
                computed.binary_search_by_key(&row.track, |&at| all[written[at] as usize].template_row).is_ok()
            });
            let mut proxies = Gaussians::zeros(merged.len() + computed.len(), self.info.sh_degree);
            proxies.write_rows(0, &first);
            proxies.write_rows(merged.len(), &self.tracks.states(&template, &of_frame)?);
            for (proxy, at) in merged.into_iter().chain(computed).enumerate() {
                rows[at].proxy = Some(proxy as u32);
            }
            let change = compressed.delta_at(frame, frames.paths().len()).pick(&written);
            let name = template.path().file_name().unwrap_or_default();
            write_like_template(&template, &rows, &proxies, &change, compressed.sh_degree, &folder.join(name))?;
            progress.advance(1);
            Ok(())
        };
        // Frames are written in batches: while a thread waits for proxies, it would otherwise begin another frame.
        let numbers: Vec<usize> = (0..frames.paths().len()).collect();
        numbers.chunks(rayon::current_num_threads()).try_for_each(|batch| batch.par_iter().try_for_each(write))
    }
}
