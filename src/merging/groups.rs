//! Groups of Gaussians that merging has joined, each with a leader: the Gaussian into which the others are merged.

/// Partition of the survivors (Gaussians left by pruning) into groups. A Gaussian is identified by its row in the table
/// of survivors. Groups are ordered by the row of their leader, the Gaussian into which the others are merged. Memory:
/// at most 12 bytes per row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MergeGroups {
    leaders: Vec<u32>,
    start: Vec<u32>,
    members: Vec<u32>,
}

impl MergeGroups {
    /// Creates one group for each Gaussian in `rows` (increasing row indices). No Gaussian is merged.
    pub fn singletons(rows: &[u32]) -> Self {
        MergeGroups { leaders: rows.to_vec(), start: (0..=rows.len() as u32).collect(), members: rows.to_vec() }
    }

    /// Merges groups with one another, and returns the resulting groups. `leader_of[g]` is the index of the group that
    /// group g joins, or g itself if it joins none. A resulting group has the leader (Gaussian into which the others
    /// are merged) of the group that the others joined.
    pub fn joined(&self, leader_of: &[u32]) -> Self {
        let mut new_index = vec![0; leader_of.len()];
        let mut leaders = Vec::new();
        for (group, &leader) in leader_of.iter().enumerate() {
            if group as u32 == leader {
                new_index[group] = leaders.len() as u32;
                leaders.push(self.leaders[group]);
            }
        }
        let joined = |group: usize| new_index[leader_of[group] as usize] as usize;
        let mut start = vec![0; leaders.len() + 1];
        for group in 0..self.group_count() {
            start[joined(group) + 1] += self.members(group).len() as u32;
        }
        for group in 0..leaders.len() {
            start[group + 1] += start[group];
        }
        let mut next = start.clone();
        let mut members = vec![0; self.members.len()];
        for group in 0..self.group_count() {
            let (place, group_members) = (&mut next[joined(group)], self.members(group));
            members[*place as usize..][..group_members.len()].copy_from_slice(group_members);
            *place += group_members.len() as u32;
        }
        for group in start.windows(2) {
            members[group[0] as usize..group[1] as usize].sort_unstable();
        }
        MergeGroups { leaders, start, members }
    }

    /// Returns the number of groups.
    pub fn group_count(&self) -> usize {
        self.leaders.len()
    }

    /// Returns the row of every group's leader, the Gaussian into which the others are merged; rows are increasing.
    pub fn leaders(&self) -> &[u32] {
        &self.leaders
    }

    /// Returns the rows of all Gaussians of group number `group`, including its leader (the Gaussian into which the
    /// others are merged); rows are increasing.
    pub fn members(&self, group: usize) -> &[u32] {
        &self.members[self.start[group] as usize..self.start[group + 1] as usize]
    }

    /// Returns the indices of the groups that have more than one Gaussian.
    pub fn clusters(&self) -> impl Iterator<Item = u32> {
        (0..self.group_count() as u32).filter(|&group| self.members(group as usize).len() > 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joining_twice_flattens_to_original_rows() {
        // Rows 2 and 4 join row 5. Then the group of row 5 joins that of row 1.
        let once = MergeGroups::singletons(&[1, 2, 3, 4, 5]).joined(&[0, 4, 2, 4, 4]);
        assert_eq!(once.leaders(), [1, 3, 5]);
        assert_eq!((once.members(0), once.members(1), once.members(2)), (&[1][..], &[3][..], &[2, 4, 5][..]));
        let twice = once.joined(&[0, 1, 0]);
        assert_eq!((twice.leaders(), twice.group_count()), (&[1, 3][..], 2));
        assert_eq!((twice.members(0), twice.members(1)), (&[1, 2, 4, 5][..], &[3][..]));
        assert_eq!(MergeGroups::singletons(&[]).joined(&[]).group_count(), 0);
    }
}
