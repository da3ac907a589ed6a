//! Memory limits and memory use of this process on Linux.
//!
//! The limits are read from files in `/proc` and in the folders of control groups. Tests read copies of such files
//! below another root folder than `/`.

use std::fs;
use std::path::{Component, Path, PathBuf};

use crate::{LimitSource, MemoryLimit, MemoryLimits};

/// Returns the physical memory of the machine, the limits of the control group of this process and of its parent
/// groups, and the limits that `ulimit` sets for this process. Limits that the system does not report are missing.
pub fn memory_limits() -> MemoryLimits {
    limits_under(Path::new("/"))
}

/// Reads the memory limits of this process from the system files below the folder `root`, which stands for `/`.
fn limits_under(root: &Path) -> MemoryLimits {
    let read = |path: &Path| fs::read_to_string(root.join(path.strip_prefix("/").unwrap_or(path))).ok();
    let mut shared = Vec::from_iter(machine_limit(&read));
    add_groups(&read, &mut shared);
    MemoryLimits { shared, process: process_limits(&read) }
}

/// Returns the physical memory of the machine as a limit. `read` returns the text of a system file.
fn machine_limit(read: &impl Fn(&Path) -> Option<String>) -> Option<MemoryLimit> {
    let info = read(Path::new("/proc/meminfo"))?;
    let total = info.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    let kibibytes: u64 = total.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(MemoryLimit { bytes: kibibytes.saturating_mul(1024), source: LimitSource::Machine })
}

/// Appends to `limits` the limits of the control group of this process and of its parent groups, which apply to this
/// process too. Parent groups that are not mounted in the file system are skipped. `read` returns the text of a system
/// file.
fn add_groups(read: &impl Fn(&Path) -> Option<String>, limits: &mut Vec<MemoryLimit>) {
    let (Some(memberships), Some(mounts)) =
        (read(Path::new("/proc/self/cgroup")), read(Path::new("/proc/self/mountinfo")))
    else {
        return;
    };
    for membership in memberships.lines() {
        // Fields of a line of `/proc/self/cgroup`: number of the hierarchy, controllers (empty in version 2), path of
        // the group.
        let mut fields = membership.splitn(3, ':').skip(1);
        let (Some(controllers), Some(path)) = (fields.next(), fields.next()) else { continue };
        let (kind, files): (&str, &[&str]) = match controllers {
            "" => ("cgroup2", &["memory.max", "memory.high"]),
            some if some.split(',').any(|controller| controller == "memory") => ("cgroup", &["memory.limit_in_bytes"]),
            _ => continue,
        };
        for mount in
            mounts.lines().filter_map(Mount::from_line).filter(|mount| mount.kind == kind && mount.limits_memory)
        {
            for folder in mount.folder_of(path).ancestors().take_while(|folder| folder.starts_with(&mount.point)) {
                for file in files.iter().map(|file| folder.join(file)) {
                    let bytes = read(&file).and_then(|text| text.trim().parse().ok());
                    limits.extend(bytes.map(|bytes| MemoryLimit { bytes, source: LimitSource::ControlGroup(file) }));
                }
            }
        }
    }
}

/// Mount of a hierarchy of control groups (cgroups) in the file system. A mount shows one control group and all groups
/// below it as folders.
struct Mount {
    /// Path of the mounted group within the hierarchy of control groups; `/` if the whole hierarchy is mounted.
    root: PathBuf,
    /// Folder of the file system at which the hierarchy of control groups is mounted (mount point).
    point: PathBuf,
    /// File system type of the mount: `cgroup2`, or `cgroup` for control groups of version 1.
    kind: String,
    /// Whether the control groups of this hierarchy can limit memory. Some hierarchies of version 1 cannot.
    limits_memory: bool,
}

impl Mount {
    /// Parses a line of `/proc/self/mountinfo`: numbers, device, root, mount point, options, a dash, file system type,
    /// source, options. Returns `None` if fields are missing.
    fn from_line(line: &str) -> Option<Mount> {
        let (before_dash, after_dash) = line.split_once(" - ")?;
        let mut before_dash = before_dash.split(' ').skip(3);
        let mut after_dash = after_dash.split(' ');
        let path = |text: &str| PathBuf::from(text.replace("\\040", " "));
        let (root, point, kind) = (path(before_dash.next()?), path(before_dash.next()?), after_dash.next()?.to_owned());
        let options = after_dash.nth(1).unwrap_or("");
        let limits_memory = kind == "cgroup2" || options.split(',').any(|option| option == "memory");
        Some(Mount { root, point, kind, limits_memory })
    }

    /// Returns the folder in the file system that represents the control group `path`. Returns the mount point if the
    /// mount does not show this group.
    fn folder_of(&self, path: &str) -> PathBuf {
        let inside = Path::new(path).strip_prefix(&self.root).unwrap_or(Path::new(""));
        // With `..`, the path is relative to the root of a control group namespace that does not contain this process.
        if inside.components().any(|component| component == Component::ParentDir) {
            return self.point.clone();
        }
        self.point.join(inside)
    }
}

/// Returns the soft limits that `ulimit` sets for this process: address space and data size. `read` returns the text of
/// a system file, or `None` if it cannot be read.
fn process_limits(read: &impl Fn(&Path) -> Option<String>) -> Vec<MemoryLimit> {
    let text = read(Path::new("/proc/self/limits")).unwrap_or_default();
    let soft = |name: &str, source| {
        let soft = text.lines().find_map(|line| line.strip_prefix(name)?.split_whitespace().next())?;
        Some(MemoryLimit { bytes: soft.parse().ok()?, source })
    };
    let limits = [soft("Max address space", LimitSource::AddressSpace), soft("Max data size", LimitSource::DataSize)];
    limits.into_iter().flatten().collect()
}

/// Returns the largest resident memory (in physical memory, mapped files included) that this process has had so far, in
/// bytes (`VmHWM`). Returns `None` if the system gives no answer.
pub fn peak_memory_bytes() -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib * 1024)
}

/// Makes [`peak_memory_bytes`] start again at the present resident memory. Returns whether the system did so.
pub fn reset_peak_memory() -> bool {
    fs::write("/proc/self/clear_refs", "5").is_ok()
}

/// Makes the allocator return every freed block of 256 KiB or more to the system at once, so that the resident memory
/// of this process does not include freed memory. By default, glibc keeps freed blocks of up to 32 MiB in the heaps of
/// the threads that allocated them: one run took between 62 and 69 MiB that way, and 43 MiB with this function. Costs
/// up to 5% more processor time, because returned pages have to be cleared when they are used again. No effect with
/// other allocators than that of glibc.
pub fn return_freed_memory() {
    #[cfg(target_env = "gnu")]
    // SAFETY: `mallopt` only sets a parameter of the allocator. It may be called at any time.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, 256 << 10);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::UNLIMITED_BYTES;

    const GIB: u64 = 1 << 30;
    const V2: &str = "30 23 0:26 / /sys/fs/cgroup rw,nosuid shared:4 - cgroup2 cgroup2 rw,nsdelegate\n";
    const NO_LIMITS: &str = "Limit                     Soft Limit           Hard Limit           Units\n\
        Max data size             unlimited            unlimited            bytes\n\
        Max address space         unlimited            unlimited            bytes\n";

    /// Returns the lowest memory limit, in bytes, and its source on a simulated machine with 64 GiB and the system
    /// files `files`, given as pairs (path, content).
    fn limit(files: &[(&str, &str)]) -> (u64, LimitSource) {
        let root = tempfile::tempdir().unwrap();
        let machine =
            [("proc/meminfo", "MemFree: 1 kB\nMemTotal:       67108864 kB\n"), ("proc/self/limits", NO_LIMITS)];
        for (name, text) in machine.iter().chain(files) {
            let path = root.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        let MemoryLimits { shared, process } = limits_under(root.path());
        let stated = shared.into_iter().chain(process).filter(|limit| (1..UNLIMITED_BYTES).contains(&limit.bytes));
        stated.min_by_key(|limit| limit.bytes).map(|limit| (limit.bytes, limit.source)).unwrap()
    }

    fn group(file: &str) -> LimitSource {
        LimitSource::ControlGroup(file.into())
    }

    #[test]
    fn machine_is_the_limit_without_control_groups() {
        assert_eq!(limit(&[]), (64 * GIB, LimitSource::Machine));
        assert_eq!(limits_under(Path::new("/no/such/root")), MemoryLimits::default());
    }

    #[test]
    fn lowest_limit_of_all_parent_groups_is_named() {
        let nested = |job: &str, step: &str, high: &str| {
            limit(&[
                ("proc/self/cgroup", "0::/slurm/job_7/step_0\n"),
                ("proc/self/mountinfo", V2),
                ("sys/fs/cgroup/slurm/memory.max", "max\n"),
                ("sys/fs/cgroup/slurm/job_7/memory.max", job),
                ("sys/fs/cgroup/slurm/job_7/step_0/memory.max", step),
                ("sys/fs/cgroup/slurm/job_7/step_0/memory.high", high),
            ])
        };
        let group_limit = |bytes: u64, file: &str| (bytes, group(&format!("/sys/fs/cgroup/slurm/job_7/{file}")));
        assert_eq!(nested("4294967296", "max", "max"), group_limit(4 * GIB, "memory.max"));
        assert_eq!(nested("4294967296", "2147483648\n", "max"), group_limit(2 * GIB, "step_0/memory.max"));
        assert_eq!(nested("max", "2147483648\n", "1073741824"), group_limit(GIB, "step_0/memory.high"));
        assert_eq!(nested("max", "max", "0").0, 64 * GIB);
        assert_eq!(
            nested("max", "137438953472", "max").0,
            64 * GIB,
            "a limit above the physical memory must not count"
        );
    }

    #[test]
    fn limits_of_version_1_groups_are_found() {
        let mounts = "40 35 0:35 / /sys/fs/cgroup/unified rw - cgroup2 cgroup2 rw\n\
            41 35 0:36 / /sys/fs/cgroup/cpu,cpuacct rw - cgroup cgroup rw,cpu,cpuacct\n\
            42 35 0:37 / /sys/fs/cgroup/memory rw - cgroup cgroup rw,memory\n";
        let found = limit(&[
            ("proc/self/cgroup", "9:memory:/batch/job\n4:cpu,cpuacct:/batch/job\n0::/batch\n"),
            ("proc/self/mountinfo", mounts),
            ("sys/fs/cgroup/memory/memory.limit_in_bytes", "9223372036854771712"),
            ("sys/fs/cgroup/memory/batch/memory.limit_in_bytes", "3221225472"),
            ("sys/fs/cgroup/memory/batch/job/memory.limit_in_bytes", "9223372036854771712"),
            ("sys/fs/cgroup/cpu,cpuacct/batch/job/memory.limit_in_bytes", "1"),
        ]);
        let file = "/sys/fs/cgroup/memory/batch/memory.limit_in_bytes";
        assert_eq!(found, (3 * GIB, group(file)));
    }

    #[test]
    fn limit_is_found_if_a_part_of_the_hierarchy_is_mounted() {
        let v1 = "42 35 0:37 /docker/abc /sys/fs/cgroup/memory ro - cgroup cgroup rw,memory\n";
        for (group, mounts, file) in [
            ("0::/\n", V2, "sys/fs/cgroup/memory.max"),
            ("0::/../../elsewhere\n", V2, "sys/fs/cgroup/memory.max"),
            ("9:memory:/docker/abc\n", v1, "sys/fs/cgroup/memory/memory.limit_in_bytes"),
            ("9:memory:/docker/abc/inner\n", v1, "sys/fs/cgroup/memory/inner/memory.limit_in_bytes"),
        ] {
            let files = [("proc/self/cgroup", group), ("proc/self/mountinfo", mounts), (file, "1073741824\n")];
            assert_eq!(limit(&files).0, GIB, "{group}");
        }
    }

    #[test]
    fn limits_of_the_process_itself_apply() {
        let limits = NO_LIMITS.replace("space         unlimited ", "space         1073741824");
        assert_eq!(limit(&[("proc/self/limits", &limits)]), (GIB, LimitSource::AddressSpace));
    }
}
