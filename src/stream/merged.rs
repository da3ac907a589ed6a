//! A sequence of explicit trajectories with its clusters merged, frame by frame as it is read.
//!
//! At every frame a proxy is the moment match of its members at that frame, with the weights of the
//! reference frame: Σ w_i x_i(t) is its path. Nothing is stored; memory is that of the members read.

use std::ops::Range;

use crate::error::Result;
use crate::merge::proxy::merge_state;
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::pass::{BlockReader, FrameSource, Ids};
use crate::recipe::{Merge, Placement};

/// What is kept of a source.
pub struct MergedSequence<'a> {
    source: &'a dyn FrameSource,
    info: SequenceInfo,
    /// Ids of the source, one per Gaussian of this sequence; a proxy has its leader's.
    kept: &'a [u32],
    /// Members (id, weight) of each Gaussian that is a proxy; empty for the others.
    members: Vec<&'a [(u32, f64)]>,
    merge: Merge,
}

impl<'a> MergedSequence<'a> {
    /// The Gaussians `kept` of `source`, those at `clusters` (place in `kept`, members by id) replaced
    /// by proxies. A path that is known needs no leader to follow, so proxies go to the mean.
    pub fn new(
        source: &'a dyn FrameSource,
        kept: &'a [u32],
        clusters: impl Iterator<Item = (u32, &'a [(u32, f64)])>,
        merge: &Merge,
    ) -> Self {
        let mut members: Vec<&[(u32, f64)]> = vec![&[]; kept.len()];
        for (place, of_cluster) in clusters {
            members[place as usize] = of_cluster;
        }
        // A proxy of members of which one moves moves.
        let varying = if source.info().varying.is_empty() { Columns::NONE } else { Columns::ALL };
        let some = members.iter().any(|members| !members.is_empty());
        let info = SequenceInfo {
            count: kept.len(),
            varying: if some { varying } else { source.info().varying },
            ..source.info().clone()
        };
        MergedSequence { source, info, kept, members, merge: Merge { placement: Placement::Mean, ..merge.clone() } }
    }
}

impl FrameSource for MergedSequence<'_> {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        let places: Vec<usize> = ids.iter().collect();
        // First one row per Gaussian, then the rows of all members.
        let mut rows: Vec<u32> = places.iter().map(|&place| self.kept[place]).collect();
        let mut proxies = Vec::new();
        for (row, &place) in places.iter().enumerate() {
            let members = self.members[place];
            if !members.is_empty() {
                let first = rows.len();
                rows.extend(members.iter().map(|&(id, _)| id));
                let leader = members.iter().position(|&(id, _)| id == self.kept[place]).unwrap_or(0);
                proxies.push(Proxy { row, members: first..rows.len(), leader: (first + leader) as u32, place });
            }
        }
        let state = Gaussians::zeros(rows.len(), self.info.sh_degree);
        Ok(Box::new(MergedReader {
            sequence: self,
            reader: self.source.open(Ids::List(&rows))?,
            state,
            known: Columns::NONE,
            len: places.len(),
            proxies,
        }))
    }
}

struct Proxy {
    row: usize,
    members: Range<usize>,
    leader: u32,
    place: usize,
}

struct MergedReader<'a> {
    sequence: &'a MergedSequence<'a>,
    reader: Box<dyn BlockReader + 'a>,
    state: Gaussians,
    /// What `state` holds of columns that are the same at every frame.
    known: Columns,
    len: usize,
    proxies: Vec<Proxy>,
}

impl BlockReader for MergedReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        // Moments mix position, rotation and scale, and opacity follows from areas.
        let needed = if self.proxies.is_empty() { want } else { Columns::ALL };
        self.reader.read(frame, needed.without(self.known), &mut self.state)?;
        self.known = self.known | needed.without(self.sequence.source.info().varying);
        for column in want.iter() {
            let (from, to) = (self.state.column(column), out.column_mut(column));
            to.resize(self.len);
            for c in 0..from.width() {
                to.plane_mut(c).copy_from_slice(&from.plane(c)[..self.len]);
            }
        }
        for proxy in &self.proxies {
            let weights = self.sequence.members[proxy.place].iter().map(|&(_, weight)| weight);
            let members: Vec<(u32, f64)> = proxy.members.clone().map(|row| row as u32).zip(weights).collect();
            merge_state(&members, &self.state, proxy.leader, &self.sequence.merge).write(want, proxy.row, out);
        }
        Ok(())
    }

    fn hold(&mut self, frames: usize) {
        self.reader.hold(frames);
    }
}
