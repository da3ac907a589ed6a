//! Memory limit of this process, and where the limit comes from: the machine, a control group that contains the
//! process, a batch job, or limits of the process itself.
//!
//! Input: the limits that the system reports, and environment variables. Output: the smallest limit.

use splat_platform::{LimitSource, MemoryLimit, MemoryLimits, UNLIMITED_BYTES, memory_limits};
pub use splat_platform::{peak_memory_bytes, reset_peak_memory, return_freed_memory};

use crate::error::ShowPath;

/// Returns the bytes of memory that this process may take, and a description of where this limit comes from. Returns
/// [`u64::MAX`] bytes if the system reports no limit.
pub fn memory_limit() -> (u64, String) {
    least_limit(memory_limits(), |name| std::env::var(name).ok())
}

/// Returns the smallest of the memory limits `system` and of the limits in the environment variables of a batch job, in
/// bytes, with a description of its source. `variable` looks up an environment variable.
fn least_limit(system: MemoryLimits, variable: impl Fn(&str) -> Option<String>) -> (u64, String) {
    let mut limits: Vec<(u64, String)> = system.shared.into_iter().map(described).collect();
    add_job_limits(&variable, &mut limits);
    limits.extend(system.process.into_iter().map(described));
    // Of equal limits the first is taken: the machine's own rather than that of a job that may use all of the machine.
    let stated = limits.into_iter().filter(|&(bytes, _)| (1..UNLIMITED_BYTES).contains(&bytes));
    stated.min_by_key(|&(bytes, _)| bytes).unwrap_or((u64::MAX, "this system tells of no limit".to_owned()))
}

/// Returns the bytes of a memory limit and a description of its source for display.
fn described(limit: MemoryLimit) -> (u64, String) {
    let origin = match limit.source {
        LimitSource::Machine => "the machine's memory".to_owned(),
        LimitSource::ControlGroup(file) => format!("the control group's {}", file.shown()),
        LimitSource::JobObject => "the memory limit of the process's job object".to_owned(),
        LimitSource::AddressSpace => {
            "the process's own limit of address space (ulimit -v), which mapped files count against too".to_owned()
        }
        LimitSource::DataSize => "the process's own limit of data (ulimit -d)".to_owned(),
    };
    (limit.bytes, origin)
}

/// Adds to `limits` the memory in bytes, if any, that a Slurm batch job requested on this node, with a description of
/// its source. `variable` looks up an environment variable. The node may enforce a lower limit, or none.
fn add_job_limits(variable: &impl Fn(&str) -> Option<String>, limits: &mut Vec<(u64, String)>) {
    let size = |name: &str| parse_slurm_size(&variable(name)?);
    if let Some(bytes) = size("SLURM_MEM_PER_NODE") {
        limits.push((bytes, "the job's SLURM_MEM_PER_NODE".to_owned()));
    }
    let count = |name: &str| variable(name)?.trim().parse::<u64>().ok();
    let cpus = count("SLURM_CPUS_ON_NODE").or_else(|| count("SLURM_CPUS_PER_TASK"));
    if let Some((bytes, cpus)) = size("SLURM_MEM_PER_CPU").zip(cpus) {
        limits.push((bytes.saturating_mul(cpus), format!("the job's SLURM_MEM_PER_CPU for {cpus} CPUs")));
    }
}

/// Parses a memory size in the form of Slurm's environment variables: a number of mebibytes, or a number followed by K,
/// M, G or T. Returns bytes; `None` for other text.
fn parse_slurm_size(text: &str) -> Option<u64> {
    let text = text.trim();
    let digits = text.trim_end_matches(|unit: char| unit.is_ascii_alphabetic());
    let shift = match text[digits.len()..].to_ascii_uppercase().trim_end_matches('B') {
        "K" => 10,
        "" | "M" => 20,
        "G" => 30,
        "T" => 40,
        _ => return None,
    };
    digits.parse::<u64>().ok()?.checked_mul(1 << shift)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    const GIB: u64 = 1 << 30;
    const MACHINE: MemoryLimit = MemoryLimit { bytes: 64 * GIB, source: LimitSource::Machine };

    /// Returns the memory limit, bytes, of a batch job with these environment variables on a machine of 64 GiB.
    fn job(variables: &[(&str, &str)]) -> u64 {
        let variables: BTreeMap<_, _> = variables.iter().copied().collect();
        let system = MemoryLimits { shared: vec![MACHINE], process: Vec::new() };
        least_limit(system, |name| variables.get(name).map(|&value| value.to_owned())).0
    }

    /// Returns the memory limit, bytes, of a process outside any batch job, and the description of its source. The
    /// arguments are the limits that the system reports:
    /// - `shared`: limits that the process shares with other processes: the memory of the machine, and limits of groups
    ///   of processes;
    /// - `process`: limits of this process alone.
    fn limit(shared: &[MemoryLimit], process: &[MemoryLimit]) -> (u64, String) {
        least_limit(MemoryLimits { shared: shared.to_vec(), process: process.to_vec() }, |_| None)
    }

    #[test]
    fn machine_memory_is_the_default_limit() {
        assert_eq!(limit(&[MACHINE], &[]), (64 * GIB, "the machine's memory".to_owned()));
        assert_eq!(limit(&[], &[]), (u64::MAX, "this system tells of no limit".to_owned()));
    }

    #[test]
    fn smallest_limit_is_named_and_zero_or_huge_is_no_limit() {
        let group =
            |bytes| MemoryLimit { bytes, source: LimitSource::ControlGroup("/sys/fs/cgroup/memory.max".into()) };
        let found = limit(&[MACHINE, group(4 * GIB)], &[]);
        assert_eq!(found, (4 * GIB, "the control group's /sys/fs/cgroup/memory.max".to_owned()));
        for none in [0, UNLIMITED_BYTES, 128 * GIB] {
            assert_eq!(limit(&[MACHINE, group(none)], &[]).0, 64 * GIB, "{none}");
        }
    }

    #[test]
    fn a_job_may_have_less_than_its_node() {
        assert_eq!(job(&[("SLURM_MEM_PER_NODE", "2048")]), 2 * GIB);
        assert_eq!(job(&[("SLURM_MEM_PER_NODE", "3G")]), 3 * GIB);
        assert_eq!(job(&[("SLURM_MEM_PER_NODE", "1048576K")]), GIB);
        assert_eq!(
            job(&[("SLURM_MEM_PER_CPU", "512"), ("SLURM_CPUS_ON_NODE", "8"), ("SLURM_CPUS_PER_TASK", "2")]),
            4 * GIB
        );
        assert_eq!(job(&[("SLURM_MEM_PER_CPU", "1G"), ("SLURM_CPUS_PER_TASK", "2")]), 2 * GIB);
        // Values that set no limit: 0 for all memory of the node, unknown values, and a product that overflows.
        for all in ["0", "lots", "", "9T9", "18446744073709551615T"] {
            assert_eq!(job(&[("SLURM_MEM_PER_NODE", all)]), 64 * GIB, "{all}");
        }
        assert_eq!(job(&[("SLURM_MEM_PER_CPU", "1G")]), 64 * GIB);
    }

    #[test]
    fn limit_of_the_process_itself_counts() {
        let own = [MemoryLimit { bytes: GIB, source: LimitSource::AddressSpace }];
        let (bytes, origin) = limit(&[MACHINE], &own);
        assert_eq!(bytes, GIB);
        assert!(origin.contains("ulimit -v") && origin.contains("mapped files"), "{origin}");
    }
}
