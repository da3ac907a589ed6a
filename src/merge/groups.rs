//! A partition of survivors into groups, each with a leader.

/// Groups of the rows 0..M, in the order of their leaders' rows. Memory: 16 bytes per row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Groups {
    leaders: Vec<u32>,
    start: Vec<u32>,
    members: Vec<u32>,
    group_of: Vec<u32>,
}

impl Groups {
    /// Every row for itself.
    pub fn alone(rows: usize) -> Self {
        let all: Vec<u32> = (0..rows as u32).collect();
        Groups { leaders: all.clone(), start: (0..=rows as u32).collect(), members: all.clone(), group_of: all }
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
        let group_of: Vec<u32> =
            self.group_of.iter().map(|&group| number[leader_of[group as usize] as usize]).collect();
        let mut start = vec![0; leaders.len() + 1];
        for &group in &group_of {
            start[group as usize + 1] += 1;
        }
        for group in 0..leaders.len() {
            start[group + 1] += start[group];
        }
        let mut next = start.clone();
        let mut members = vec![0; group_of.len()];
        for (row, &group) in group_of.iter().enumerate() {
            let place = &mut next[group as usize];
            members[*place as usize] = row as u32;
            *place += 1;
        }
        Groups { leaders, start, members, group_of }
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

    /// The group of every row: the index map from old to new.
    pub fn group_of(&self) -> &[u32] {
        &self.group_of
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joining_twice_flattens_to_original_rows() {
        // Rows 1 and 3 join 4; then group of 4 joins that of 0.
        let once = Groups::alone(5).joined(&[0, 4, 2, 4, 4]);
        assert_eq!(once.leaders(), [0, 2, 4]);
        assert_eq!((once.members(0), once.members(1), once.members(2)), (&[0][..], &[2][..], &[1, 3, 4][..]));
        let twice = once.joined(&[0, 1, 0]);
        assert_eq!((twice.leaders(), twice.group_of()), (&[0, 2][..], &[0, 0, 1, 0, 0][..]));
        assert_eq!(twice.members(0), [0, 1, 3, 4]);
        assert!(Groups::alone(0).joined(&[]).is_empty());
    }
}
