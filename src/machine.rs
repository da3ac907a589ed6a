//! How much memory this process may take, and who says so: the machine, a control group that it or one around it is
//! in, a batch job, or the process's own limits.
//!
//! In: files below a root folder, usually `/`, and variables of the environment. Out: the least of what they say.

use std::fs;
use std::path::{Component, Path, PathBuf};

use crate::error::ShowPath;

/// No memory is as large; version 1 groups without a limit name some such number.
const UNLIMITED: u64 = 1 << 62;

/// Bytes of memory that this process may take, and where that number comes from. As many as there are where the
/// system tells nothing.
pub fn memory_limit() -> (u64, String) {
    limit_under(Path::new("/"), |name| std::env::var(name).ok())
}

/// The least limit that the files below `root` and the variables tell of.
fn limit_under(root: &Path, variable: impl Fn(&str) -> Option<String>) -> (u64, String) {
    let read = |path: &Path| fs::read_to_string(root.join(path.strip_prefix("/").unwrap_or(path))).ok();
    let mut limits = Vec::new();
    limits.extend(of_machine(&read));
    of_groups(&read, &mut limits);
    of_job(&variable, &mut limits);
    of_process(&read, &mut limits);
    // Of equals the first: the machine's own rather than a job's that has all of it.
    let told = limits.into_iter().filter(|&(bytes, _)| (1..UNLIMITED).contains(&bytes));
    told.min_by_key(|&(bytes, _)| bytes).unwrap_or((u64::MAX, "this system tells of no limit".to_owned()))
}

fn of_machine(read: &impl Fn(&Path) -> Option<String>) -> Option<(u64, String)> {
    let info = read(Path::new("/proc/meminfo"))?;
    let total = info.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    let kibibytes: u64 = total.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some((kibibytes.saturating_mul(1024), "the machine's memory".to_owned()))
}

/// Limits of the group of this process and of every group around it that is in sight: all of them hold.
fn of_groups(read: &impl Fn(&Path) -> Option<String>, limits: &mut Vec<(u64, String)>) {
    let (Some(memberships), Some(mounts)) =
        (read(Path::new("/proc/self/cgroup")), read(Path::new("/proc/self/mountinfo")))
    else {
        return;
    };
    for membership in memberships.lines() {
        // Number, controllers (none in version 2), path.
        let mut fields = membership.splitn(3, ':').skip(1);
        let (Some(controllers), Some(path)) = (fields.next(), fields.next()) else { continue };
        let (kind, files): (&str, &[&str]) = match controllers {
            "" => ("cgroup2", &["memory.max", "memory.high"]),
            some if some.split(',').any(|controller| controller == "memory") => ("cgroup", &["memory.limit_in_bytes"]),
            _ => continue,
        };
        for mount in mounts.lines().filter_map(Mount::of).filter(|mount| mount.kind == kind && mount.limits_memory) {
            for folder in mount.folder_of(path).ancestors().take_while(|folder| folder.starts_with(&mount.point)) {
                for file in files.iter().map(|file| folder.join(file)) {
                    let bytes = read(&file).and_then(|text| text.trim().parse().ok());
                    limits.extend(bytes.map(|bytes| (bytes, format!("the control group's {}", file.shown()))));
                }
            }
        }
    }
}

/// Where a tree of control groups is mounted, or a part of it.
struct Mount {
    /// The part's path in the tree.
    root: PathBuf,
    point: PathBuf,
    /// The type of file system.
    kind: String,
    /// Version 1 has trees without it; in version 2 files tell.
    limits_memory: bool,
}

impl Mount {
    /// A line of mountinfo: numbers, device, root, point, options, then behind a dash type, source, options.
    fn of(line: &str) -> Option<Mount> {
        let (before, behind) = line.split_once(" - ")?;
        let mut before = before.split(' ').skip(3);
        let mut behind = behind.split(' ');
        let path = |text: &str| PathBuf::from(text.replace("\\040", " "));
        let (root, point, kind) = (path(before.next()?), path(before.next()?), behind.next()?.to_owned());
        let options = behind.nth(1).unwrap_or("");
        let limits_memory = kind == "cgroup2" || options.split(',').any(|option| option == "memory");
        Some(Mount { root, point, kind, limits_memory })
    }

    /// The folder of the group `path`; of a group that is not in the part, that of the part.
    fn folder_of(&self, path: &str) -> PathBuf {
        let inside = Path::new(path).strip_prefix(&self.root).unwrap_or(Path::new(""));
        // Relative to the root of a namespace that this process is outside of.
        if inside.components().any(|component| component == Component::ParentDir) {
            return self.point.clone();
        }
        self.point.join(inside)
    }
}

/// What a Slurm job asked for on this node. A node may enforce less than that, or nothing.
fn of_job(variable: &impl Fn(&str) -> Option<String>, limits: &mut Vec<(u64, String)>) {
    let size = |name: &str| slurm_size(&variable(name)?);
    if let Some(bytes) = size("SLURM_MEM_PER_NODE") {
        limits.push((bytes, "the job's SLURM_MEM_PER_NODE".to_owned()));
    }
    let of_cpus = |name: &str| variable(name)?.trim().parse::<u64>().ok();
    let cpus = of_cpus("SLURM_CPUS_ON_NODE").or_else(|| of_cpus("SLURM_CPUS_PER_TASK"));
    if let Some((bytes, cpus)) = size("SLURM_MEM_PER_CPU").zip(cpus) {
        limits.push((bytes.saturating_mul(cpus), format!("the job's SLURM_MEM_PER_CPU for {cpus} CPUs")));
    }
}

/// Mebibytes, or with K, M, G or T behind it what that says.
fn slurm_size(text: &str) -> Option<u64> {
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

fn of_process(read: &impl Fn(&Path) -> Option<String>, limits: &mut Vec<(u64, String)>) {
    let Some(text) = read(Path::new("/proc/self/limits")) else { return };
    for (name, origin) in [
        (
            "Max address space",
            "the process's own limit of address space (ulimit -v), which mapped files count against too",
        ),
        ("Max data size", "the process's own limit of data (ulimit -d)"),
    ] {
        let soft = text.lines().find_map(|line| line.strip_prefix(name)?.split_whitespace().next());
        limits.extend(soft.and_then(|soft| soft.parse().ok()).map(|bytes| (bytes, origin.to_owned())));
    }
}

/// Largest resident memory of this process so far, mapped pages included (`VmHWM`); none where the
/// system does not say.
pub fn peak_memory_bytes() -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib * 1024)
}

/// Lets [`peak_memory_bytes`] begin anew from what is resident now; false where the system has no such thing.
pub fn reset_peak_memory() -> bool {
    fs::write("/proc/self/clear_refs", "5").is_ok()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    const GIB: u64 = 1 << 30;
    const V2: &str = "30 23 0:26 / /sys/fs/cgroup rw,nosuid shared:4 - cgroup2 cgroup2 rw,nsdelegate\n";
    const NO_LIMITS: &str = "Limit                     Soft Limit           Hard Limit           Units\n\
        Max data size             unlimited            unlimited            bytes\n\
        Max address space         unlimited            unlimited            bytes\n";

    /// A machine of 64 GiB with these files, and what is found on it.
    fn limit(files: &[(&str, &str)], variables: &[(&str, &str)]) -> (u64, String) {
        let root = tempfile::tempdir().unwrap();
        let machine =
            [("proc/meminfo", "MemFree: 1 kB\nMemTotal:       67108864 kB\n"), ("proc/self/limits", NO_LIMITS)];
        for (name, text) in machine.iter().chain(files) {
            let path = root.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        let variables: BTreeMap<_, _> = variables.iter().copied().collect();
        limit_under(root.path(), |name| variables.get(name).map(|&value| value.to_owned()))
    }

    #[test]
    fn without_anything_else_the_machine_is_the_limit_and_without_that_nothing() {
        assert_eq!(limit(&[], &[]), (64 * GIB, "the machine's memory".to_owned()));
        let nowhere = limit_under(Path::new("/no/such/root"), |_| None);
        assert_eq!(nowhere, (u64::MAX, "this system tells of no limit".to_owned()));
    }

    #[test]
    fn every_group_around_the_process_counts_and_the_tightest_is_named() {
        let nested = |job: &str, step: &str, high: &str| {
            limit(
                &[
                    ("proc/self/cgroup", "0::/slurm/job_7/step_0\n"),
                    ("proc/self/mountinfo", V2),
                    ("sys/fs/cgroup/slurm/memory.max", "max\n"),
                    ("sys/fs/cgroup/slurm/job_7/memory.max", job),
                    ("sys/fs/cgroup/slurm/job_7/step_0/memory.max", step),
                    ("sys/fs/cgroup/slurm/job_7/step_0/memory.high", high),
                ],
                &[],
            )
        };
        let of = |bytes: u64, file: &str| (bytes, format!("the control group's /sys/fs/cgroup/slurm/job_7/{file}"));
        assert_eq!(nested("4294967296", "max", "max"), of(4 * GIB, "memory.max"));
        assert_eq!(nested("4294967296", "2147483648\n", "max"), of(2 * GIB, "step_0/memory.max"));
        assert_eq!(nested("max", "2147483648\n", "1073741824"), of(GIB, "step_0/memory.high"));
        assert_eq!(nested("max", "max", "0").0, 64 * GIB);
        assert_eq!(nested("max", "137438953472", "max").0, 64 * GIB, "a limit above the machine's memory is none");
    }

    #[test]
    fn groups_of_version_1_and_of_both_versions_are_followed() {
        let mounts = "40 35 0:35 / /sys/fs/cgroup/unified rw - cgroup2 cgroup2 rw\n\
            41 35 0:36 / /sys/fs/cgroup/cpu,cpuacct rw - cgroup cgroup rw,cpu,cpuacct\n\
            42 35 0:37 / /sys/fs/cgroup/memory rw - cgroup cgroup rw,memory\n";
        let found = limit(
            &[
                ("proc/self/cgroup", "9:memory:/batch/job\n4:cpu,cpuacct:/batch/job\n0::/batch\n"),
                ("proc/self/mountinfo", mounts),
                ("sys/fs/cgroup/memory/memory.limit_in_bytes", "9223372036854771712"),
                ("sys/fs/cgroup/memory/batch/memory.limit_in_bytes", "3221225472"),
                ("sys/fs/cgroup/memory/batch/job/memory.limit_in_bytes", "9223372036854771712"),
                ("sys/fs/cgroup/cpu,cpuacct/batch/job/memory.limit_in_bytes", "1"),
            ],
            &[],
        );
        let file = "/sys/fs/cgroup/memory/batch/memory.limit_in_bytes";
        assert_eq!(found, (3 * GIB, format!("the control group's {file}")));
    }

    #[test]
    fn a_container_that_sees_a_part_of_the_tree_finds_its_limit() {
        let v1 = "42 35 0:37 /docker/abc /sys/fs/cgroup/memory ro - cgroup cgroup rw,memory\n";
        for (group, mounts, file) in [
            ("0::/\n", V2, "sys/fs/cgroup/memory.max"),
            ("0::/../../elsewhere\n", V2, "sys/fs/cgroup/memory.max"),
            ("9:memory:/docker/abc\n", v1, "sys/fs/cgroup/memory/memory.limit_in_bytes"),
            ("9:memory:/docker/abc/inner\n", v1, "sys/fs/cgroup/memory/inner/memory.limit_in_bytes"),
        ] {
            let files = [("proc/self/cgroup", group), ("proc/self/mountinfo", mounts), (file, "1073741824\n")];
            assert_eq!(limit(&files, &[]).0, GIB, "{group}");
        }
    }

    #[test]
    fn a_job_may_have_less_than_its_node() {
        let job = |variables: &[(&str, &str)]| limit(&[], variables).0;
        assert_eq!(job(&[("SLURM_MEM_PER_NODE", "2048")]), 2 * GIB);
        assert_eq!(job(&[("SLURM_MEM_PER_NODE", "3G")]), 3 * GIB);
        assert_eq!(job(&[("SLURM_MEM_PER_NODE", "1048576K")]), GIB);
        assert_eq!(
            job(&[("SLURM_MEM_PER_CPU", "512"), ("SLURM_CPUS_ON_NODE", "8"), ("SLURM_CPUS_PER_TASK", "2")]),
            4 * GIB
        );
        assert_eq!(job(&[("SLURM_MEM_PER_CPU", "1G"), ("SLURM_CPUS_PER_TASK", "2")]), 2 * GIB);
        // All of the node; unknown; a product beyond all numbers.
        for all in ["0", "lots", "", "9T9", "18446744073709551615T"] {
            assert_eq!(job(&[("SLURM_MEM_PER_NODE", all)]), 64 * GIB, "{all}");
        }
        assert_eq!(job(&[("SLURM_MEM_PER_CPU", "1G")]), 64 * GIB);
    }

    #[test]
    fn a_limit_of_the_process_itself_holds() {
        let limits = NO_LIMITS.replace("space         unlimited ", "space         1073741824");
        let (bytes, origin) = limit(&[("proc/self/limits", &limits)], &[]);
        assert_eq!(bytes, GIB);
        assert!(origin.contains("ulimit -v") && origin.contains("mapped files"), "{origin}");
    }
}
