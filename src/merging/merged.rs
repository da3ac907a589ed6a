//! A sequence of explicit trajectories with its clusters merged, frame by frame as it is read.
//!
//! At every frame a proxy is the moment match of its members at that frame, with the weights of the
//! reference frame: Σ w_i x_i(t) is its path. Nothing is stored; memory is that of the members read. Members lie
//! anywhere in the source: whoever reads many Gaussians reads them together ([`MergedSequence::together`]), so that
//! what is decoded for one serves all.

use std::ops::Range;

use rayon::prelude::*;

use crate::error::Result;
use crate::merging::proxy::{ProxyState, merge_state};
use crate::model::{Columns, Gaussians, SequenceInfo};
use crate::passes::FrameReaders;
use crate::recipe::{MergeParams, Placement};
use crate::source::{BlockReader, FrameSource, Ids, ReadPlan, Reads};

/// Columns that follow from one another: moments mix position, rotation and scale, and opacity follows from areas.
const MIXED: Columns = Columns::all().difference(Columns::SH);

/// Proxies made at a time.
const BATCH: usize = 4096;

/// What is kept of a source.
pub struct MergedSequence<'a> {
    source: &'a dyn FrameSource,
    info: SequenceInfo,
    /// Ids of the source, one per Gaussian of this sequence; a proxy has its leader's.
    kept: &'a [u32],
    /// Members (id, weight) of each Gaussian that is a proxy; empty for the others.
    members: Vec<&'a [(u32, f64)]>,
    merge: MergeParams,
}

impl<'a> MergedSequence<'a> {
    /// The Gaussians `kept` of `source`, those at `clusters` (place in `kept`, members by id) replaced
    /// by proxies. A path that is known needs no leader to follow, so proxies go to the mean.
    pub fn new(
        source: &'a dyn FrameSource,
        kept: &'a [u32],
        clusters: impl Iterator<Item = (u32, &'a [(u32, f64)])>,
        merge: &MergeParams,
    ) -> Self {
        let mut members: Vec<&[(u32, f64)]> = vec![&[]; kept.len()];
        for (place, of_cluster) in clusters {
            members[place as usize] = of_cluster;
        }
        let mut varying = source.info().varying;
        if !(varying & MIXED).is_empty() && members.iter().any(|members| !members.is_empty()) {
            varying |= MIXED;
        }
        let info = SequenceInfo { count: kept.len(), varying, ..source.info().clone() };
        MergedSequence {
            source,
            info,
            kept,
            members,
            merge: MergeParams { placement: Placement::Mean, ..merge.clone() },
        }
    }
}

impl MergedSequence<'_> {
    /// A reader of the Gaussians `places` at the frames `wanted` that reads what they are made of together, on all
    /// threads.
    ///
    /// Memory per Gaussian needed, members included: its reader, its state at one frame, and 24 bytes.
    pub fn together(&self, places: Range<usize>, wanted: &ReadPlan) -> Result<Box<dyn BlockReader + '_>> {
        let merging = MergedMembers::new(self, places);
        let frames = FrameReaders::open(self.source, Ids::List(&merging.ids), Columns::all(), wanted)?;
        Ok(Box::new(MergedReader::new(self, Box::new(frames), merging)))
    }

    /// How many Gaussians of the source that at `place` is made of.
    pub fn members(&self, place: usize) -> usize {
        self.members[place].len().max(1)
    }
}

impl FrameSource for MergedSequence<'_> {
    fn info(&self) -> &SequenceInfo {
        &self.info
    }

    fn open(&self, ids: Ids<'_>) -> Result<Box<dyn BlockReader + '_>> {
        let merging = MergedMembers::new(self, ids.iter());
        let reader = self.source.open(Ids::List(&merging.ids))?;
        Ok(Box::new(MergedReader::new(self, reader, merging)))
    }

    fn open_all(&self, wanted: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        Some(self.together(0..self.kept.len(), wanted))
    }

    fn reads(&self) -> Reads {
        self.source.reads()
    }
}

/// What some Gaussians are made of.
struct MergedMembers {
    /// Everybody needed, by id in the source.
    ids: Vec<u32>,
    /// For every Gaussian the row of its own id in `ids`.
    rows: Vec<u32>,
    proxies: Vec<Proxy>,
    /// Row in `ids` and weight of the members of all proxies.
    members: Vec<(u32, f64)>,
}

struct Proxy {
    /// Which of the Gaussians it is.
    row: usize,
    members: Range<usize>,
}

impl MergedMembers {
    fn new(sequence: &MergedSequence<'_>, places: impl IntoIterator<Item = usize>) -> MergedMembers {
        let places: Vec<usize> = places.into_iter().collect();
        let mut ids: Vec<u32> = places.iter().map(|&place| sequence.kept[place]).collect();
        ids.extend(places.iter().flat_map(|&place| sequence.members[place].iter().map(|&(id, _)| id)));
        ids.sort_unstable();
        ids.dedup();
        let row_of = |id: u32| ids.binary_search(&id).unwrap_or_default() as u32;
        let rows = places.iter().map(|&place| row_of(sequence.kept[place])).collect();
        let (mut proxies, mut members) = (Vec::new(), Vec::new());
        for (row, &place) in places.iter().enumerate().filter(|&(_, &place)| !sequence.members[place].is_empty()) {
            let first = members.len();
            members.extend(sequence.members[place].iter().map(|&(id, weight)| (row_of(id), weight)));
            proxies.push(Proxy { row, members: first..members.len() });
        }
        MergedMembers { ids, rows, proxies, members }
    }

    /// Columns of the members that `want` takes.
    fn needed(&self, want: Columns) -> Columns {
        if self.proxies.is_empty() || want.is_empty() { want } else { want | MIXED }
    }

    /// Writes the columns `want` of the Gaussians, made of `state`, to `out`.
    fn write(&self, state: &Gaussians, want: Columns, merge: &MergeParams, out: &mut Gaussians) {
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

struct MergedReader<'a> {
    sequence: &'a MergedSequence<'a>,
    reader: Box<dyn BlockReader + 'a>,
    state: Gaussians,
    /// What `state` holds of columns that are the same at every frame.
    known: Columns,
    merging: MergedMembers,
}

impl<'a> MergedReader<'a> {
    fn new(sequence: &'a MergedSequence<'a>, reader: Box<dyn BlockReader + 'a>, merging: MergedMembers) -> Self {
        let state = Gaussians::zeros(merging.ids.len(), sequence.info.sh_degree);
        MergedReader { sequence, reader, state, known: Columns::empty(), merging }
    }
}

impl BlockReader for MergedReader<'_> {
    fn read(&mut self, frame: usize, want: Columns, out: &mut Gaussians) -> Result<()> {
        let needed = self.merging.needed(want);
        self.reader.read(frame, needed.difference(self.known), &mut self.state)?;
        self.known |= needed.difference(self.sequence.source.info().varying);
        self.merging.write(&self.state, want, &self.sequence.merge, out);
        Ok(())
    }

    fn expect(&mut self, wanted: &ReadPlan) {
        self.reader.expect(wanted);
    }
}
