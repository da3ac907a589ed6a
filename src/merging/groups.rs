//! A partition of survivors into groups, each with a leader.

/// Groups of some rows, in the order of their leaders' rows. Memory: 12 bytes per row at most.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MergeGroups {
    leaders: Vec<u32>,
    start: Vec<u32>,
    members: Vec<u32>,
}

impl MergeGroups {
    /// Each of `rows` (increasing) for itself.
    pub fn alone(rows: &[u32]) -> Self {
        MergeGroups { leaders: rows.to_vec(), start: (0..=rows.len() as u32).collect(), members: rows.to_vec() }
    }

    /// These groups after group g joined group `leader_of[g]`, which stayed its own; the joined
    /// group's leader is that of the group it joined.
    pub fn joined(&self, leader_of: &[u32]) -> Self {
        let mut number = vec![0; leader_of.len()];
        let mut leaders = Vec::new();
        for (group, &leader) in leader_of.iter().enumerate() {
            if group as u32 == leader {
                number[group] = leaders.len() as u32;
                leaders.push(self.leaders[group]);
            }
        }
        let joined = |group: usize| number[leader_of[group] as usize] as usize;
        let mut start = vec![0; leaders.len() + 1];
        for group in 0..self.len() {
            start[joined(group) + 1] += self.members(group).len() as u32;
        }
        for group in 0..leaders.len() {
            start[group + 1] += start[group];
        }
        let mut next = start.clone();
        let mut members = vec![0; self.members.len()];
        for group in 0..self.len() {
            let (place, of_group) = (&mut next[joined(group)], self.members(group));
            members[*place as usize..][..of_group.len()].copy_from_slice(of_group);
            *place += of_group.len() as u32;
        }
        for group in start.windows(2) {
            members[group[0] as usize..group[1] as usize].sort_unstable();
        }
        MergeGroups { leaders, start, members }
    }

    /// Number of groups.
    pub fn len(&self) -> usize {
        self.leaders.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.leaders.is_empty()
    }

    /// The leader's row for every group, increasing.
    pub fn leaders(&self) -> &[u32] {
        &self.leaders
    }

    /// The rows of group `group`, its leader among them, increasing.
    pub fn members(&self, group: usize) -> &[u32] {
        &self.members[self.start[group] as usize..self.start[group + 1] as usize]
    }

    /// The groups of more than one member.
    pub fn clusters(&self) -> impl Iterator<Item = u32> {
        (0..self.len() as u32).filter(|&group| self.members(group as usize).len() > 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joining_twice_flattens_to_original_rows() {
        // Rows 2 and 4 join 5; then group of 5 joins that of 1.
        let once = MergeGroups::alone(&[1, 2, 3, 4, 5]).joined(&[0, 4, 2, 4, 4]);
        assert_eq!(once.leaders(), [1, 3, 5]);
        assert_eq!((once.members(0), once.members(1), once.members(2)), (&[1][..], &[3][..], &[2, 4, 5][..]));
        let twice = once.joined(&[0, 1, 0]);
        assert_eq!((twice.leaders(), twice.len()), (&[1, 3][..], 2));
        assert_eq!((twice.members(0), twice.members(1)), (&[1, 2, 4, 5][..], &[3][..]));
        assert!(MergeGroups::alone(&[]).joined(&[]).is_empty());
    }
}
