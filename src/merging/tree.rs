//! A k-d tree that stays fast if points coincide, and the list of the nearest points found so far.
//!
//! Input: points. Output: those nearest to a position, ordered by distance, then index. Memory: 28 bytes per node, with
//! two nodes for every 4 to 8 points, that is 7 to 14 bytes per point.
//!
//! Every node stores the smallest index below it. A subtree is skipped unless it can hold a pair (distance, index) that
//! is smaller than the worst one found so far. With ten million points at one position all distances are equal, so the
//! K smallest indices are found at once and all other points are skipped; a tree that prunes by distance alone would
//! visit every point for every query.

/// Maximum number of points in a leaf.
const MAX_LEAF_POINTS: usize = 8;
/// Number of points below which one thread builds a subtree alone.
const MIN_PARALLEL_POINTS: usize = 1 << 14;

/// A point and its index.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TreePoint {
    /// Position of the point.
    pub position: [f32; 3],
    /// Index of the point. Of two points at equal distance, the one with the smaller index counts as nearer.
    pub index: u32,
}

/// Candidate for a neighbor: bits of its squared distance (≥ 0, so bits have the order of the values), then its index.
type NeighborCandidate = (u64, u32);

/// List of the nearest points to a position found so far, up to the requested number.
///
/// The list collects candidates, unsorted. As soon as it has twice the requested number K of them, it drops the farther
/// half. A heap would move about log K candidates for each candidate added.
#[derive(Debug, Default)]
pub struct NearestPoints {
    query_index: u32,
    position: [f64; 3],
    max_neighbors: usize,
    worst: NeighborCandidate,
    candidates: Vec<NeighborCandidate>,
}

impl NearestPoints {
    /// Starts a new query: for the `max_neighbors` nearest points to `position`, other than the point with index
    /// `query_index`, within the distance `epsilon`.
    ///
    /// Squared distances are summed in f64 and compared with ε².
    pub fn start_query(&mut self, query_index: u32, position: [f32; 3], max_neighbors: usize, epsilon: f64) {
        self.candidates.clear();
        (self.query_index, self.position, self.max_neighbors) = (query_index, position.map(f64::from), max_neighbors);
        self.worst = ((epsilon * epsilon).to_bits(), u32::MAX);
    }

    /// Adds every point in `points` that can still be one of the requested nearest points.
    fn add_points(&mut self, points: &[TreePoint]) {
        for point in points {
            let candidate =
                (squared(std::array::from_fn(|c| f64::from(point.position[c]) - self.position[c])), point.index);
            if candidate <= self.worst && point.index != self.query_index {
                self.candidates.push(candidate);
                if self.candidates.len() == 2 * self.max_neighbors {
                    self.drop_far();
                }
            }
        }
    }

    /// Returns the points found as (bits of the squared distance, index), nearest first, equal distances by index.
    pub fn sort_by_distance(&mut self) -> &[(u64, u32)] {
        if self.candidates.len() > self.max_neighbors {
            self.drop_far();
        }
        self.candidates.sort_unstable();
        &self.candidates
    }

    fn drop_far(&mut self) {
        self.worst = *self.candidates.select_nth_unstable(self.max_neighbors - 1).1;
        self.candidates.truncate(self.max_neighbors);
    }
}

#[derive(Debug, Clone, Copy)]
struct Node {
    low: [f32; 3],
    high: [f32; 3],
    smallest_index: u32,
}

/// Perfect binary tree over points. Its nodes are in preorder, and all leaves have the same depth.
#[derive(Debug)]
pub struct Tree {
    nodes: Vec<Node>,
    depth: u32,
}

impl Tree {
    /// Builds a tree over `points`, and sorts `points` in the order of the tree's leaves.
    pub fn new(points: &mut [TreePoint]) -> Self {
        let depth = points.len().div_ceil(MAX_LEAF_POINTS).next_power_of_two().trailing_zeros();
        let empty = Node { low: [f32::INFINITY; 3], high: [f32::NEG_INFINITY; 3], smallest_index: u32::MAX };
        let mut nodes = vec![empty; (2usize << depth) - 1];
        build(points, &mut nodes);
        Tree { nodes, depth }
    }

    /// Searches the tree for the points nearest to the position in `nearest`, and adds them to `nearest`. Skips
    /// subtrees that hold no point nearer than the worst one found so far. `points`: all points of the tree, in the
    /// order that [`Tree::new`] gave them.
    pub fn search(&self, points: &[TreePoint], nearest: &mut NearestPoints) {
        self.visit(0, self.depth, points, self.nodes[0].nearest_possible(nearest.position), nearest);
    }

    fn visit(
        &self,
        node: usize,
        depth: u32,
        points: &[TreePoint],
        bound: NeighborCandidate,
        nearest: &mut NearestPoints,
    ) {
        if bound > nearest.worst {
            return;
        }
        if depth == 0 {
            nearest.add_points(points);
            return;
        }
        let (before, behind) = points.split_at(points.len() / 2);
        let (left, right) = (node + 1, node + (1 << depth));
        let near = self.nodes[left].nearest_possible(nearest.position);
        let far = self.nodes[right].nearest_possible(nearest.position);
        if near <= far {
            self.visit(left, depth - 1, before, near, nearest);
            self.visit(right, depth - 1, behind, far, nearest);
        } else {
            self.visit(right, depth - 1, behind, far, nearest);
            self.visit(left, depth - 1, before, near, nearest);
        }
    }
}

impl Node {
    /// Returns a lower bound of the pair (squared distance to `position`, index) over all points below this node.
    /// Rounding to f64 never makes the distance to the node's box larger than the distance to a point in it, because
    /// every operation of the sum is monotone.
    fn nearest_possible(&self, position: [f64; 3]) -> NeighborCandidate {
        let outside =
            |c: usize| (f64::from(self.low[c]) - position[c]).max(position[c] - f64::from(self.high[c])).max(0.0);
        (squared(std::array::from_fn(outside)), self.smallest_index)
    }
}

fn squared(d: [f64; 3]) -> u64 {
    (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).to_bits()
}

/// Builds a perfect subtree over `points` into `nodes`, in preorder. Splits the points at the median of the widest side
/// of their box. Equal coordinates are split by index, so that low indices are found first.
fn build(points: &mut [TreePoint], nodes: &mut [Node]) {
    let Some((node, descendants)) = nodes.split_first_mut() else { return };
    for point in points.iter() {
        for c in 0..3 {
            node.low[c] = node.low[c].min(point.position[c]);
            node.high[c] = node.high[c].max(point.position[c]);
        }
        node.smallest_index = node.smallest_index.min(point.index);
    }
    if descendants.is_empty() || points.is_empty() {
        return;
    }
    let side = |c: usize| f64::from(node.high[c]) - f64::from(node.low[c]);
    let widest = (1..3).fold(0, |best, c| if side(c) > side(best) { c } else { best });
    let middle = points.len() / 2;
    points.select_nth_unstable_by(middle, |a, b| {
        a.position[widest].total_cmp(&b.position[widest]).then(a.index.cmp(&b.index))
    });
    let (left, right) = points.split_at_mut(middle);
    let (left_nodes, right_nodes) = descendants.split_at_mut(descendants.len() / 2);
    if left.len() >= MIN_PARALLEL_POINTS {
        rayon::join(|| build(left, left_nodes), || build(right, right_nodes));
    } else {
        build(left, left_nodes);
        build(right, right_nodes);
    }
}
