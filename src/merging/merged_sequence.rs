//! A sequence in which proxies (one Gaussian per cluster) replace clusters of merged Gaussians. The proxies are
//! computed while frames are read.
//!
//! The state of a proxy at a frame has the weighted mean and covariance of its members (the Gaussians of its cluster)
//! at that frame. The weights are those of the reference frame for all frames, so the trajectory is Σ w_i x_i(t). No
//! proxy is stored; only the members being read are in memory. The members of a proxy may be anywhere in the source.
//! Many Gaussians are best read by [`MergedSequence::open_together`], because a block of the source that is decoded for
//! one of them then serves all.

use std::ops::Range;

use crate::error::Result;
use crate::merging::proxy::{for_each_proxy, merge_member_states};
use crate::model::{Attributes, Gaussians, SequenceInfo};
use crate::passes::FrameReaders;
use crate::recipe::{MergeParams, ProxyPosition};
use crate::source::{BlockReader, FrameSource, Ids, ReadCounts, ReadPlan};

/// Attributes of a proxy (Gaussian that replaces a merged cluster) that are always computed together: all except SH.
/// Position, rotation and scale follow from mean and covariance of the members; the opacity follows from the members'
/// opacities and areas.
const MIXED: Attributes = Attributes::all().difference(Attributes::SH);

/// Sequence of the survivors (Gaussians left by pruning) of a source, in which a proxy replaces each merged cluster.
pub struct MergedSequence<'a> {
    source: &'a dyn FrameSource,
    info: SequenceInfo,
    /// Id in the source of each Gaussian of this sequence. A proxy has the id of its leader, the Gaussian into which
    /// the others are merged.
    survivors: &'a [u32],
    /// For each Gaussian of this sequence that is a proxy: the ids and weights of the Gaussians it replaces; otherwise
    /// empty.
    members: Vec<&'a [(u32, f64)]>,
    merge: MergeParams,
}

impl<'a> MergedSequence<'a> {
    /// Creates the sequence of the Gaussians `survivors` (ids) of `source`, some of which are replaced by proxies.
    /// - `clusters`: for each proxy, the index in `survivors` of the Gaussian that it replaces (the leader of its
    ///   cluster), then the ids and weights of the cluster's members.
    /// - `merge`: parameters by which proxies are computed. Its rule for the position is not used: a proxy is at the
    ///   mean of its members at every frame, so it need not move with the leader.
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
            merge: MergeParams { placement: ProxyPosition::Mean, ..merge.clone() },
        }
    }
}

impl MergedSequence<'_> {
    /// Opens a reader of the Gaussians with the indices `places` in this sequence, at the frames `plan`. A proxy is
    /// computed from its members, the Gaussians of the cluster. The members of all proxies among `places` are read
    /// together, on all threads. Fails if a Gaussian cannot be read.
    ///
    /// Memory for each Gaussian that is read, members of proxies included: its reader, its state at one frame, and 24
    /// bytes.
    pub fn open_together(&self, places: Range<usize>, plan: &ReadPlan) -> Result<Box<dyn BlockReader + '_>> {
        let inputs = MergedMembers::new(self, places);
        let frames = FrameReaders::open(self.source, Ids::List(&inputs.ids), Attributes::all(), plan)?;
        Ok(Box::new(MergedSequenceReader::new(self, Box::new(frames), inputs)))
    }

    /// Returns the number of source Gaussians that the Gaussian with index `place` of this sequence replaces: the size
    /// of its merged cluster if it is a proxy, otherwise 1.
    pub fn member_count(&self, place: usize) -> usize {
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

    fn open_all(&self, plan: &ReadPlan) -> Option<Result<Box<dyn BlockReader + '_>>> {
        Some(self.open_together(0..self.survivors.len(), plan))
    }

    fn reads(&self) -> ReadCounts {
        self.source.reads()
    }
}

/// Gaussians of the source that must be read for a selection of Gaussians of this sequence.
struct MergedMembers {
    /// Ids in the source of all Gaussians that must be read, increasing.
    ids: Vec<u32>,
    /// For every Gaussian selected for reading, the index of its id in `ids`. A proxy has the id of its leader (most
    /// important member).
    rows: Vec<u32>,
    proxies: Vec<Proxy>,
    /// For every proxy and every member of its cluster: the index of the member's id in `ids`, then the weight of the
    /// member. The members of one proxy follow one another.
    members: Vec<(u32, f64)>,
}

struct Proxy {
    /// Index of this proxy among the Gaussians selected for reading.
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

    /// Returns the attributes that must be read from the source to compute the attributes `want` of the selected
    /// Gaussians. These are `want` and, if a selected Gaussian is a proxy, also [`MIXED`].
    fn needed(&self, want: Attributes) -> Attributes {
        if self.proxies.is_empty() || want.is_empty() { want } else { want | MIXED }
    }

    /// Computes the attributes `want` of the selected Gaussians from the source Gaussians `state`, by the parameters
    /// `merge` for proxies, and writes them to `out`.
    fn write(&self, state: &Gaussians, want: Attributes, merge: &MergeParams, out: &mut Gaussians) {
        for column in want.iter() {
            let (from, to) = (state.attribute_values(column), out.attribute_values_mut(column));
            to.resize(self.rows.len());
            for c in 0..from.width() {
                let plane = from.plane(c);
                to.plane_mut(c).iter_mut().zip(&self.rows).for_each(|(to, &row)| *to = plane[row as usize]);
            }
        }
        if want.is_empty() {
            return;
        }
        let compute = |proxy: &Proxy| {
            merge_member_states(&self.members[proxy.members.clone()], state, self.rows[proxy.row], merge, want)
        };
        for_each_proxy(&self.proxies, compute, |proxy, state| state.write(want, proxy.row, out));
    }
}

struct MergedSequenceReader<'a> {
    sequence: &'a MergedSequence<'a>,
    reader: Box<dyn BlockReader + 'a>,
    state: Gaussians,
    /// Attributes that do not vary with time and were already read into `state`.
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

    fn expect(&mut self, plan: &ReadPlan) {
        self.reader.expect(plan);
    }
}
