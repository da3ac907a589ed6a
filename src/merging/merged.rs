//! A sequence with explicit frames whose clusters are merged frame by frame while it is read.
//!
//! At every frame a proxy is the moment match of its members at that frame, with the weights of the reference frame;
//! its trajectory is Σ w_i x_i(t). Nothing is stored; the memory is that of the members being read. The members of a
//! proxy may lie anywhere in the source. A caller that reads many Gaussians reads them together
//! ([`MergedSequence::together`]), so that blocks decoded for one Gaussian serve all of them.

use std::ops::Range;

use rayon::prelude::*;

use crate::error::Result;
use crate::merging::proxy::{ProxyState, merge_state};
use crate::model::{Attributes, Gaussians, SequenceInfo};
use crate::passes::FrameReaders;
use crate::recipe::{MergeParams, Placement};
use crate::source::{BlockReader, FrameSource, Ids, ReadPlan, Reads};

/// Attributes that depend on each other in a proxy: moments mix position, rotation and scale, and opacity depends on
/// areas.
const MIXED: Attributes = Attributes::all().difference(Attributes::SH);

/// Number of proxies computed in one batch.
const BATCH: usize = 4096;

/// Survivors of a source, with clusters replaced by proxies.
pub struct MergedSequence<'a> {
    source: &'a dyn FrameSource,
    info: SequenceInfo,
    /// Ids in the source, one per Gaussian of this sequence; a proxy has its leader's id.
    survivors: &'a [u32],
    /// Members (id, weight) of each Gaussian that is a proxy; empty for other Gaussians.
    members: Vec<&'a [(u32, f64)]>,
    merge: MergeParams,
}

impl<'a> MergedSequence<'a> {
    /// Creates the sequence of the Gaussians `survivors` of `source`, with the Gaussians at `clusters` (index into
    /// `survivors`, members by id) replaced by proxies. Proxies are placed at the mean of their members: with a known
    /// trajectory they need not follow their leader.
    pub fn new(
        source: &'a dyn FrameSource,
        survivors: &'a [u32],
        clusters: impl Iterator<Item = (u32, &'a [(u32, f64)])>,
        merge: &MergeParams,
    ) -> Self {
        let mut members: Vec<&[(u32, f64)]> = vec![&[]; survivors.len()];
        for (place, cluster_members) in clusters {
            members[place as usize] = cluster_members;
        }
        let mut varying = source.info().varying;
        if !(varying & MIXED).is_empty() && members.iter().any(|members| !members.is_empty()) {
            varying |= MIXED;
        }
        let info = SequenceInfo { count: survivors.len(), varying, ..source.info().clone() };
        MergedSequence {
            source,
            info,
            survivors,
            members,
            merge: MergeParams { placement: Placement::Mean, ..merge.clone() },
        }
    }
}

impl MergedSequence<'_> {
    /// Opens a reader of the Gaussians `places` at the frames `wanted` that reads all their members together, on all
    /// threads.
    ///
    /// Memory per Gaussian to be read, members included: its reader, its state at one frame, and 24 bytes.
    pub fn together(&self, places: Range<usize>, wanted: &ReadPlan) -> Result<Box<dyn BlockReader + '_>> {
        let inputs = MergedMembers::new(self, places);
        let frames = FrameReaders::open(self.source, Ids::List(&inputs.ids), Attributes::all(), wanted)?;
        Ok(Box::new(MergedSequenceReader::new(self, Box::new(frames), inputs)))
    }

    /// Returns the number of source Gaussians from which the Gaussian at `place` is made; 1 if it is not a proxy.
    pub fn members(&self, place: usize) -> usize {
        self.members[place].len().max(1)
    }
}

impl FrameSource for MergedSequence<'_> {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        let inputs = MergedMembers::new(self, ids.iter());
        let reader = self.source.open(Ids::List(&inputs.ids))?;
        Ok(Box::new(MergedSequenceReader::new(self, reader, inputs)))
    }

    fn open_all(&self, wanted: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        Some(self.together(0..self.survivors.len(), wanted))
    }

    fn reads(&self) -> Reads {
        self.source.reads()
    }
}

/// Source Gaussians needed for a selection of Gaussians of the sequence.
struct MergedMembers {
    /// Ids in the source of all Gaussians to be read, increasing.
    ids: Vec<u32>,
    /// Row in `ids` of the own id of every selected Gaussian.
    rows: Vec<u32>,
    proxies: Vec<Proxy>,
    /// Row in `ids` and weight of the members of all proxies.
    members: Vec<(u32, f64)>,
}

struct Proxy {
    /// Index of the proxy among the selected Gaussians.
    row: usize,
    members: Range<usize>,
}

impl MergedMembers {
    fn new(sequence: &MergedSequence<'_>, places: impl IntoIterator<Item = usize>) -> MergedMembers {
        let places: Vec<usize> = places.into_iter().collect();
        let mut ids: Vec<u32> = places.iter().map(|&place| sequence.survivors[place]).collect();
        ids.extend(places.iter().flat_map(|&place| sequence.members[place].iter().map(|&(id, _)| id)));
        ids.sort_unstable();
        ids.dedup();
        let find_row = |id: u32| ids.binary_search(&id).unwrap_or_default() as u32;
        let rows = places.iter().map(|&place| find_row(sequence.survivors[place])).collect();
        let (mut proxies, mut members) = (Vec::new(), Vec::new());
        for (row, &place) in places.iter().enumerate().filter(|&(_, &place)| !sequence.members[place].is_empty()) {
            let first = members.len();
            members.extend(sequence.members[place].iter().map(|&(id, weight)| (find_row(id), weight)));
            proxies.push(Proxy { row, members: first..members.len() });
        }
        MergedMembers { ids, rows, proxies, members }
    }

    /// Returns the attributes of the members that must be read to compute the attributes `want`.
    fn needed(&self, want: Attributes) -> Attributes {
        if self.proxies.is_empty() || want.is_empty() { want } else { want | MIXED }
    }

    /// Writes the attributes `want` of the selected Gaussians, computed from the source states `state`, to `out`.
    fn write(&self, state: &Gaussians, want: Attributes, merge: &MergeParams, out: &mut Gaussians) {
        for column in want.iter() {
            let (from, to) = (state.column(column), out.column_mut(column));
            to.resize(self.rows.len());
            for c in 0..from.width() {
                let plane = from.plane(c);
                to.plane_mut(c).iter_mut().zip(&self.rows).for_each(|(to, &row)| *to = plane[row as usize]);
            }
        }
        if want.is_empty() {
            return;
        }
        for batch in self.proxies.chunks(BATCH) {
            let made: Vec<ProxyState> = batch
                .par_iter()
                .map(|proxy| {
                    merge_state(&self.members[proxy.members.clone()], state, self.rows[proxy.row], merge, want)
                })
                .collect();
            batch.iter().zip(&made).for_each(|(proxy, made)| made.write(want, proxy.row, out));
        }
    }
}

struct MergedSequenceReader<'a> {
    sequence: &'a MergedSequence<'a>,
    reader: Box<dyn BlockReader + 'a>,
    state: Gaussians,
    /// Attributes in `state` that do not vary and were already read.
    constant_read: Attributes,
    inputs: MergedMembers,
}

impl<'a> MergedSequenceReader<'a> {
    fn new(sequence: &'a MergedSequence<'a>, reader: Box<dyn BlockReader + 'a>, inputs: MergedMembers) -> Self {
        let state = Gaussians::zeros(inputs.ids.len(), sequence.info.sh_degree);
        MergedSequenceReader { sequence, reader, state, constant_read: Attributes::empty(), inputs }
    }
}

impl BlockReader for MergedSequenceReader<'_> {
    fn read(&mut self, frame: usize, want: Attributes, out: &mut Gaussians) -> Result<()> {
        let needed = self.inputs.needed(want);
        self.reader.read(frame, needed.difference(self.constant_read), &mut self.state)?;
        self.constant_read |= needed.difference(self.sequence.source.info().varying);
        self.inputs.write(&self.state, want, &self.sequence.merge, out);
        Ok(())
    }

    fn expect(&mut self, wanted: &ReadPlan) {
        self.reader.expect(wanted);
    }
}
