//! Tests of unusual outputs: links and devices in place of ordinary files, outputs shared by runs, killed runs and
//! failures to write.

use std::collections::BTreeMap;
use std::ffi::{CString, OsStr};
use std::fs::{self, File};
use std::io::Read;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{FileTypeExt, PermissionsExt, symlink};
use std::os::unix::net::UnixListener;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread;
use std::time::{Duration, Instant};

use super::runner::{Folder, Outcome, Random, SMALL_MEMORY, is_optimized, program, seed};

/// Number of Gaussians of the smallest input.
const COUNT: usize = 40;
/// First line of the lock file in a workspace of the program, defined in `src/files/atomic/workspace.rs`.
const LOCK_LINE: &str = "workspace of a splatsieve run\n";
/// Id of a user without privileges, for tests that the superuser runs.
const NOBODY: u32 = 65534;

/// Writes a PLY of [`COUNT`] Gaussians as `in.ply`, and a camera of a few pixels as `views.json`.
fn write_input(folder: &Folder) {
    let names = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    let mut bytes = format!("ply\nformat binary_little_endian 1.0\nelement vertex {COUNT}\n").into_bytes();
    names.split(' ').for_each(|name| bytes.extend(format!("property float {name}\n").bytes()));
    bytes.extend(b"end_header\n");
    let mut random = Random::new(1);
    for _ in 0..COUNT {
        let mut between = |low: f32, high: f32| low + (high - low) * random.below(1 << 20) as f32 / (1 << 20) as f32;
        let mut row: Vec<f32> = (0..3).map(|_| between(-1.0, 1.0)).collect();
        row.extend([0.0; 3]);
        row.extend((0..3).map(|_| between(-1.0, 1.0)));
        row.push(between(0.0, 3.0));
        row.extend((0..3).map(|_| between(-4.0, -2.0)));
        row.extend([1.0, 0.0, 0.0, 0.0]);
        row.iter().for_each(|value| bytes.extend(value.to_le_bytes()));
    }
    folder.write("in.ply", bytes);
    let camera = r#"{"id": 0, "img_name": "a", "width": 16, "height": 16, "fx": 16, "fy": 16, "position": [0, 0, -4],
        "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}"#;
    folder.write("views.json", format!("[{camera}]"));
}

fn folder_with_input() -> Folder {
    let folder = Folder::new();
    write_input(&folder);
    folder
}

/// Returns the names of all entries in the folder except the input files.
fn outputs(folder: &Folder) -> Vec<String> {
    folder.names().into_iter().filter(|name| name != "in.ply" && name != "views.json").collect()
}

/// Returns the arguments of the fastest run that keeps `count` Gaussians and writes four files, or a folder.
fn compress(output: &str, count: u64) -> String {
    let fast = "--cameras views.json --prune-only --no-refine --threads 1 --quiet";
    format!("compress in.ply -o {output} --count {count} {fast}")
}

/// Returns the number of Gaussians that the header of a PLY declares.
fn ply_count(path: &Path) -> usize {
    let bytes = fs::read(path).unwrap();
    let header = String::from_utf8_lossy(&bytes[..bytes.len().min(200)]).into_owned();
    let count = header.lines().find_map(|line| line.strip_prefix("element vertex ")).expect("a PLY");
    count.parse().unwrap()
}

/// Returns the number of Gaussians that each file of a result states: the output itself and the files beside it. The
/// numbers are equal if all files belong to one run. Returns `None` if no file of the result exists.
fn counts_of_set(folder: &Folder, output: &str) -> Option<Vec<usize>> {
    let path = |name: &str| match folder.path(output).is_dir() {
        true => folder.path(output).join(name),
        false => folder.path(&format!("{output}.{name}")),
    };
    let main = match folder.path(output).is_dir() {
        true => folder.path(output).join("in.ply"),
        false => folder.path(output),
    };
    let [summary, recipe, map] = ["summary.json", "recipe.toml", "index_map.npy"].map(path);
    let present = [&main, &summary, &recipe, &map].map(|path| path.exists());
    if present == [false; 4] {
        return None;
    }
    assert_eq!(present, [true; 4], "{output}: main file, summary, recipe, index map\n{:?}", folder.names());
    let summary: serde_json::Value = serde_json::from_slice(&fs::read(summary).unwrap()).unwrap();
    let recipe = fs::read_to_string(recipe).unwrap();
    let target = recipe.lines().find_map(|line| line.strip_prefix("target_count = ")).expect("a target count");
    let map = fs::read(map).unwrap();
    let start = map.len() - COUNT * 8;
    let entries = map[start..].chunks_exact(8).map(|entry| i64::from_le_bytes(entry.try_into().unwrap()));
    let kept = entries.filter(|&entry| entry >= 0).count();
    Some(vec![ply_count(&main), summary["gaussians"].as_u64().unwrap() as usize, target.parse().unwrap(), kept])
}

/// Checks that all files of a result belong to one run.
fn check_set(folder: &Folder, output: &str) {
    if let Some(counts) = counts_of_set(folder, output) {
        let is_one = counts.iter().all(|count| *count == counts[0]);
        assert!(is_one, "{output}: Gaussians in main file, summary, recipe, index map: {counts:?}");
    }
}

/// Checks that no workspace of the program is left in the folder. Entries in `foreign` have such names, but are not the
/// program's, and may remain.
fn check_no_leftovers(folder: &Folder, foreign: &[&str]) {
    let left: Vec<String> = folder.names().into_iter().filter(|name| name.contains("splatsieve-tmp")).collect();
    assert_eq!(left, foreign);
}

/// Returns all entries below a folder by path, with the contents of files and the targets of links.
fn tree(path: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(path).unwrap() {
        let path = entry.unwrap().path();
        let kind = fs::symlink_metadata(&path).unwrap();
        if kind.is_dir() {
            found.extend(tree(&path));
            found.insert(path, Vec::new());
        } else if kind.is_symlink() {
            found.insert(path.clone(), fs::read_link(&path).unwrap().as_os_str().as_bytes().to_owned());
        } else if kind.is_file() {
            found.insert(path.clone(), fs::read(&path).unwrap());
        }
    }
    found
}

fn make_fifo(path: &Path) {
    let path = CString::new(path.as_os_str().as_bytes()).unwrap();
    // SAFETY: the path is a string that ends in 0 and outlives the call.
    assert_eq!(unsafe { libc::mkfifo(path.as_ptr(), 0o600) }, 0);
}

fn is_superuser() -> bool {
    // SAFETY: the call takes no arguments and cannot fail.
    unsafe { libc::geteuid() == 0 }
}

/// Makes the folder writable for everybody. Returns a function that changes a command so that it runs as an
/// unprivileged user.
fn ordinary_user(folder: &Folder) -> impl Fn(&mut Command) {
    fs::set_permissions(folder.path(""), fs::Permissions::from_mode(0o777)).unwrap();
    |command: &mut Command| {
        if is_superuser() {
            command.uid(NOBODY);
        }
    }
}

#[test]
fn json_names_an_output_that_is_not_utf_8() {
    let folder = Folder::new();
    write_input(&folder);
    let output = OsStr::from_bytes(b"x\xff.gseq");
    let words = ["convert", "in.ply", "--json"].map(OsStr::new);
    let outcome = folder.attack_with(words.into_iter().chain([output])).run().succeeded();
    assert!(outcome.stdout.contains("x\u{fffd}.gseq"), "{}", outcome.stdout);
}

#[test]
fn link_named_like_a_leftover_is_not_followed() {
    let folder = folder_with_input();
    folder.write("victim/thesis", "years of work");
    folder.write("victim/lock", LOCK_LINE);
    let links = [".small.ply.AbCdEf.splatsieve-tmp", ".splatsieve-scratch.AbCdEf.splatsieve-tmp"];
    links.iter().for_each(|link| symlink(folder.path("victim"), folder.path(link)).unwrap());
    let before = tree(&folder.path("victim"));
    folder.attack("convert in.ply small.ply").run().succeeded();
    folder.attack(&compress("small.ply", 20)).run().refused(2, &["exists already"]);
    assert!(tree(&folder.path("victim")) == before);
    check_no_leftovers(&folder, &links);
}

#[test]
fn a_folder_named_like_a_leftover_stays() {
    for (lock, content) in [("lock", ""), ("lock", "mine"), ("lock", "workspace"), ("notes", "")] {
        let folder = folder_with_input();
        folder.write(&format!(".small.ply.AbCdEf.splatsieve-tmp/{lock}"), content);
        folder.write(".small.ply.AbCdEf.splatsieve-tmp/thesis", "years of work");
        let before = tree(&folder.path(".small.ply.AbCdEf.splatsieve-tmp"));
        folder.attack("convert in.ply small.ply").run().succeeded();
        assert!(tree(&folder.path(".small.ply.AbCdEf.splatsieve-tmp")) == before, "{lock} {content}");
    }
}

#[test]
fn lock_that_is_a_fifo_or_a_link_is_left_alone() {
    let folder = folder_with_input();
    let lock = folder.write("precious", LOCK_LINE);
    for name in [".small.ply.a.splatsieve-tmp", ".small.ply.b.splatsieve-tmp"] {
        folder.write(&format!("{name}/thesis"), "years of work");
    }
    make_fifo(&folder.path(".small.ply.a.splatsieve-tmp/lock"));
    symlink(lock, folder.path(".small.ply.b.splatsieve-tmp/lock")).unwrap();
    folder.attack("convert in.ply small.ply").run().succeeded();
    for name in ["precious", ".small.ply.a.splatsieve-tmp/thesis", ".small.ply.b.splatsieve-tmp/thesis"] {
        assert!(folder.path(name).exists(), "{name}");
    }
}

#[test]
fn link_in_a_leftover_goes_and_its_target_stays() {
    let folder = folder_with_input();
    folder.write("victim/thesis", "years of work");
    folder.write(".small.ply.AbCdEf.splatsieve-tmp/lock", LOCK_LINE);
    for name in ["content", "discarded"] {
        symlink(folder.path("victim"), folder.path(&format!(".small.ply.AbCdEf.splatsieve-tmp/{name}"))).unwrap();
    }
    folder.attack("convert in.ply small.ply").run().succeeded();
    assert!(folder.path("victim/thesis").exists());
    check_no_leftovers(&folder, &[]);
}

#[test]
fn a_character_device_is_written_and_stays() {
    let folder = folder_with_input();
    let device = folder.path("null.ply");
    let path = CString::new(device.as_os_str().as_bytes()).unwrap();
    // SAFETY: the path is a string that ends in 0 and outlives the call.
    let made = unsafe { libc::mknod(path.as_ptr(), libc::S_IFCHR | 0o666, libc::makedev(1, 3)) == 0 };
    if !made {
        symlink("/dev/null", &device).unwrap();
    }
    for flags in ["", "--overwrite", "--overwrite"] {
        folder.attack(&format!("convert in.ply null.ply {flags}")).run().succeeded();
        assert!(fs::metadata(&device).unwrap().file_type().is_char_device());
        assert_eq!(fs::symlink_metadata(&device).unwrap().is_symlink(), !made);
    }
    assert_eq!(outputs(&folder), ["null.ply"]);
}

#[test]
fn a_fifo_receives_the_result_and_stays() {
    let folder = folder_with_input();
    folder.attack("convert in.ply expected.ply").run().succeeded();
    make_fifo(&folder.path("fifo.ply"));
    let fifo = folder.path("fifo.ply");
    let reader = thread::spawn(move || {
        let mut bytes = Vec::new();
        File::open(fifo).unwrap().read_to_end(&mut bytes).unwrap();
        bytes
    });
    folder.attack("convert in.ply fifo.ply --overwrite").run().succeeded();
    assert!(reader.join().unwrap() == fs::read(folder.path("expected.ply")).unwrap());
    assert!(fs::symlink_metadata(folder.path("fifo.ply")).unwrap().file_type().is_fifo());
}

#[test]
fn standard_output_as_a_link_receives_only_the_result() {
    let folder = folder_with_input();
    symlink("/proc/self/fd/1", folder.path("out.ply")).unwrap();
    let mut command = Command::new(program());
    let output =
        command.current_dir(folder.path("")).args(["convert", "in.ply", "out.ply", "--overwrite"]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    folder.attack("convert in.ply expected.ply").run().succeeded();
    assert!(output.stdout == fs::read(folder.path("expected.ply")).unwrap());
    assert!(String::from_utf8_lossy(&output.stderr).contains("out.ply: 40 Gaussians"));
    assert!(fs::symlink_metadata(folder.path("out.ply")).unwrap().is_symlink());
}

#[test]
fn redirected_standard_output_as_a_link_is_not_replaced() {
    let folder = folder_with_input();
    symlink("/proc/self/fd/1", folder.path("out.ply")).unwrap();
    let file = File::create(folder.path("redirected")).unwrap();
    let attack = folder.attack("convert in.ply out.ply --overwrite").stdout(file);
    attack.run().refused(2, &["out.ply", "a link of the system", "give another output"]);
    assert!(fs::symlink_metadata(folder.path("out.ply")).unwrap().is_symlink());
}

#[test]
fn a_socket_is_not_replaced() {
    let folder = folder_with_input();
    let _socket = UnixListener::bind(folder.path("out.ply")).unwrap();
    for flags in ["", "--overwrite", "--overwrite"] {
        folder.attack(&format!("convert in.ply out.ply {flags}")).run().refused(2, &["out.ply", "a socket"]);
    }
    assert!(fs::symlink_metadata(folder.path("out.ply")).unwrap().file_type().is_socket());
}

#[test]
fn a_link_to_nothing_is_not_replaced() {
    let folder = folder_with_input();
    symlink("nowhere", folder.path("out.ply")).unwrap();
    folder.attack("convert in.ply out.ply --overwrite").run().refused(2, &["out.ply", "a link to nothing"]);
    assert_eq!(fs::read_link(folder.path("out.ply")).unwrap(), Path::new("nowhere"));
}

#[test]
fn several_files_do_not_go_into_a_device() {
    let folder = folder_with_input();
    symlink("/dev/null", folder.path("out.ply")).unwrap();
    make_fifo(&folder.path("b.ply.summary.json"));
    for output in ["out.ply", "b.ply"] {
        let line = compress(output, 20) + " --overwrite";
        folder.attack(&line).run().refused(2, &[output, "a device or FIFO", "several files"]);
    }
    assert_eq!(outputs(&folder), ["b.ply.summary.json", "out.ply"]);
}

#[test]
fn a_folder_does_not_replace_a_device() {
    let folder = folder_with_input();
    make_fifo(&folder.path("out"));
    folder.attack("convert in.ply out --as ply-sequence --overwrite").run().refused(2, &["out is no folder"]);
    assert!(fs::symlink_metadata(folder.path("out")).unwrap().file_type().is_fifo());
}

#[test]
fn exactly_one_of_parallel_runs_without_flags_succeeds() {
    let folder = folder_with_input();
    for round in 0..10 {
        let output = format!("{round}.ply");
        let runs: Vec<_> = (0..3).map(|run| folder.attack(&compress(&output, 10 + run)).start()).collect();
        let outcomes: Vec<Outcome> = runs.into_iter().map(|run| run.wait().ended()).collect();
        let codes: Vec<_> = outcomes.iter().map(|outcome| outcome.code).collect();
        assert_eq!(codes.iter().filter(|code| **code == Some(0)).count(), 1, "{codes:?}");
        for outcome in outcomes.iter().filter(|outcome| outcome.code != Some(0)) {
            assert!(outcome.code == Some(2) && outcome.stderr.contains("exists already"), "{}", outcome.stderr);
        }
        check_set(&folder, &output);
    }
    check_no_leftovers(&folder, &[]);
}

#[test]
fn parallel_overwriting_runs_do_not_mix_their_files() {
    let folder = folder_with_input();
    for round in 0..15 {
        let line = |run: u64| compress("small.ply", 5 + 2 * round + run) + " --overwrite";
        let runs: Vec<_> = (0..3).map(|run| folder.attack(&line(run)).start()).collect();
        runs.into_iter().for_each(|run| _ = run.wait().succeeded());
        check_set(&folder, "small.ply");
    }
    check_no_leftovers(&folder, &[]);
}

#[test]
fn huge_or_endless_summary_is_not_read() {
    let folder = folder_with_input();
    folder.attack("convert in.ply small.ply").run().succeeded();
    let summary = File::create(folder.path("small.ply.summary.json")).unwrap();
    summary.set_len(3 << 30).unwrap();
    let attack = folder.attack("convert in.ply small.ply --overwrite").run();
    attack.succeeded().within(SMALL_MEMORY.1);
    fs::create_dir(folder.path("frames")).unwrap();
    make_fifo(&folder.path("frames/summary.json"));
    folder.attack("convert in.ply frames --as ply-sequence --overwrite").run().refused(2, &["frames is not a result"]);
}

#[test]
fn a_read_only_folder_in_a_result_blocks_no_later_run() {
    let folder = folder_with_input();
    let user = ordinary_user(&folder);
    folder.attack("convert in.ply frames --as ply-sequence").with(&user).run().succeeded();
    let made = Command::new("mkdir").arg(folder.path("frames/mine")).with_user(&user).status().unwrap();
    assert!(made.success());
    folder.write("frames/mine/notes", "precious");
    fs::set_permissions(folder.path("frames/mine"), fs::Permissions::from_mode(0o555)).unwrap();
    for _ in 0..2 {
        folder.attack("convert in.ply frames --as ply-sequence --overwrite").with(&user).run().succeeded();
        assert_eq!(fs::read(folder.path("frames/mine/notes")).unwrap(), b"precious");
        assert_eq!(fs::metadata(folder.path("frames/mine")).unwrap().permissions().mode() & 0o777, 0o555);
    }
    assert_eq!(outputs(&folder), ["frames"]);
}

#[test]
fn a_folder_of_another_user_is_kept_beside_the_result() {
    if !is_superuser() {
        return;
    }
    let folder = folder_with_input();
    let user = ordinary_user(&folder);
    folder.attack("convert in.ply frames --as ply-sequence").with(&user).run().succeeded();
    folder.write("frames/theirs/notes", "precious");
    let outcome = folder.attack("convert in.ply frames --as ply-sequence --overwrite").with(&user).run().succeeded();
    let parts = ["warning: frames is in place", "frames.kept"];
    assert!(parts.iter().all(|part| outcome.stderr.contains(part)), "{}", outcome.stderr);
    assert_eq!(fs::read(folder.path("frames.kept/theirs/notes")).unwrap(), b"precious");
    let outcome = folder.attack("convert in.ply frames --as ply-sequence --overwrite").with(&user).run().succeeded();
    assert!(!outcome.stderr.contains("warning"), "{}", outcome.stderr);
    assert_eq!(outputs(&folder), ["frames", "frames.kept"]);
}

#[test]
fn folders_for_caches_and_scratch_files_lie_outside_inputs() {
    let folder = folder_with_input();
    folder.attack("convert in.ply frames --as ply-sequence").run().succeeded();
    let before = tree(&folder.path("frames"));
    for (option, place) in
        [("--cache", "frames/cache"), ("--cache", "frames"), ("--scratch-dir", "frames"), ("--scratch-dir", "link/.")]
    {
        _ = symlink(folder.path("frames"), folder.path("link"));
        let attack = folder.attack(&format!("compress frames -o small --no-refine {option} {place}"));
        attack.run().refused(2, &[option, place, "lies inside the input", "give a folder outside it"]);
    }
    assert!(tree(&folder.path("frames")) == before);
}

#[test]
fn a_file_size_limit_is_an_error_that_leaves_nothing() {
    let folder = folder_with_input();
    let limited = folder.attack("convert in.ply small.ply").with(|command| {
        // SAFETY: setrlimit may be called between fork and exec; its argument lives on the stack.
        unsafe {
            command.pre_exec(|| {
                let limit = libc::rlimit { rlim_cur: 1000, rlim_max: 1000 };
                libc::setrlimit(libc::RLIMIT_FSIZE, &limit);
                Ok(())
            });
        }
    });
    limited.run().refused(1, &["small.ply", "File too large"]);
    assert!(outputs(&folder).is_empty(), "{:?}", outputs(&folder));
}

#[test]
fn a_full_device_is_an_error() {
    let folder = folder_with_input();
    symlink("/dev/full", folder.path("full.ply")).unwrap();
    folder.attack("convert in.ply full.ply").run().refused(1, &["full.ply", "No space left"]);
    assert_eq!(outputs(&folder), ["full.ply"]);
}

#[test]
fn a_run_with_closed_streams_writes_its_result() {
    let folder = folder_with_input();
    let line = format!("{} convert in.ply small.ply <&- >&- 2>&-", program().display());
    let mut command = Command::new("sh");
    let status = command.current_dir(folder.path("")).args(["-c", &line]).status().unwrap();
    assert!(status.success());
    assert_eq!(outputs(&folder), ["small.ply"]);
}

#[test]
#[ignore = "slow: waits 10 s for a reader"]
fn slow_a_fifo_without_a_reader_is_an_error() {
    let folder = folder_with_input();
    make_fifo(&folder.path("fifo.ply"));
    let outcome = folder.attack("convert in.ply fifo.ply").within(60.0).run();
    outcome.refused(1, &["fifo.ply", "no program has opened this FIFO"]);
    assert_eq!(outputs(&folder), ["fifo.ply"]);
}

/// Method for commands that applies `user`, a function that sets the user of a command. Tests use it to start other
/// programs as the same user as the program under test.
trait WithUser {
    fn with_user(&mut self, user: impl Fn(&mut Command)) -> &mut Command;
}

impl WithUser for Command {
    fn with_user(&mut self, user: impl Fn(&mut Command)) -> &mut Command {
        user(self);
        self
    }
}

/// Number of runs that the stress test starts at the same time in each round.
const PARALLEL_RUNS: usize = 3;
/// Names of outputs that share a folder: three files with their companions, and a folder.
const SHARED: [&str; 4] = ["a.ply", "b.ply", "c.ply", "d"];

/// Prepares the folder of the stress test. Writes links and folders whose names look like leftovers of the program, and
/// foreign files beside and in outputs. Returns the names of these links and folders.
fn prepare_stress(folder: &Folder) -> Vec<&'static str> {
    folder.write("victim/thesis", "years of work");
    folder.write("victim/lock", LOCK_LINE);
    let links = [".a.ply.AbCdEf.splatsieve-tmp", ".d.AbCdEf.splatsieve-tmp", ".splatsieve-scratch.Ab.splatsieve-tmp"];
    links.iter().for_each(|link| symlink(folder.path("victim"), folder.path(link)).unwrap());
    folder.write(".b.ply.AbCdEf.splatsieve-tmp/lock", "");
    folder.write(".b.ply.AbCdEf.splatsieve-tmp/thesis", "years of work");
    folder.write("a.ply.notes", "precious");
    symlink(folder.path("victim/thesis"), folder.path("b.ply.link")).unwrap();
    folder.attack(&(compress("d", 30) + " --as ply-sequence")).run().succeeded();
    folder.write("d/notes", "precious");
    vec![links[0], ".b.ply.AbCdEf.splatsieve-tmp", links[1], links[2]]
}

/// Returns the content of each entry in the folder that no run may change.
fn foreign_entries(folder: &Folder) -> Vec<BTreeMap<PathBuf, Vec<u8>>> {
    let file = |name: &str| {
        let path = folder.path(name);
        BTreeMap::from([(path.clone(), fs::read(path).unwrap_or_else(|error| panic!("{name}: {error}")))])
    };
    let link = fs::read_link(folder.path("b.ply.link")).unwrap();
    vec![
        tree(&folder.path("victim")),
        tree(&folder.path(".b.ply.AbCdEf.splatsieve-tmp")),
        file("a.ply.notes"),
        file("d/notes"),
        file("in.ply"),
        BTreeMap::from([(link, Vec::new())]),
    ]
}

/// Returns random arguments for a run of the stress test that writes `output`.
fn stress_line(random: &mut Random, output: &str) -> String {
    // --overwrite would replace the folder with the foreign file in it.
    let flags =
        ["--overwrite", "", "--overwrite", "--overwrite"][random.below(if output == "d" { 3 } else { 4 }) as usize];
    let kind = if output == "d" { "--as ply-sequence" } else { "" };
    let cache = ["", "--cache cache-1", "--cache cache-2"][random.below(3) as usize];
    format!("{} {kind} {flags} {cache}", compress(output, 5 + random.below(31)))
}

#[test]
#[ignore = "slow: 1,000 runs"]
fn slow_killed_parallel_runs_neither_mix_nor_lose_files() {
    let folder = folder_with_input();
    let mut random = Random::new(seed(20260));
    let foreign_names = prepare_stress(&folder);
    let before = foreign_entries(&folder);
    let start = Instant::now();
    folder.attack(&compress("c.ply", 20)).run().succeeded();
    // Kills come at any time of a run, often in its last part, in which it publishes its files.
    let mut usual = start.elapsed().as_secs_f64() * PARALLEL_RUNS as f64 / 2.0;
    let (mut runs, mut kills, mut published) = (0, 0, 0);
    let total = if is_optimized() { 1000 } else { 100 };
    while runs < total {
        let mut batch = Vec::new();
        let started = Instant::now();
        for _ in 0..PARALLEL_RUNS {
            // The same output is drawn most often, so that runs collide.
            let output = SHARED[random.below(4).min(random.below(4)) as usize];
            let signal = [None, Some(libc::SIGKILL), Some(libc::SIGTERM)][random.below(3) as usize];
            let delay = usual * random.below(1000) as f64 / 800.0;
            let running = folder.attack(&stress_line(&mut random, output)).start();
            batch.push((delay, signal, running));
            runs += 1;
        }
        batch.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (delay, signal, running) in &batch {
            let Some(signal) = signal else { continue };
            thread::sleep(Duration::from_secs_f64(delay - started.elapsed().as_secs_f64().min(*delay)));
            running.signal(*signal);
        }
        for (_, signal, running) in batch {
            let outcome = running.wait();
            kills += usize::from(outcome.signal.is_some() || outcome.code == Some(128 + libc::SIGTERM));
            published += usize::from(outcome.code == Some(0));
            if signal.is_none() {
                usual = 0.9 * usual + 0.1 * outcome.seconds;
                let outcome = outcome.ended();
                let is_expected =
                    outcome.code == Some(0) || (outcome.code == Some(2) && outcome.stderr.contains("exists already"));
                assert!(is_expected, "{}: {:?}\n{}", outcome.shown, outcome.code, outcome.stderr);
            }
        }
        // The next run with each output completes or removes what the killed ones left.
        for output in SHARED {
            let kind = if output == "d" { "--as ply-sequence" } else { "" };
            let outcome = folder.attack(&format!("{} {kind} --dry-run", compress(output, 20))).run().ended();
            assert!(!outcome.stderr.contains("warning"), "{}", outcome.stderr);
            check_set(&folder, output);
        }
        assert!(foreign_entries(&folder) == before, "a foreign file changed after {runs} runs");
    }
    println!("{runs} runs, {kills} killed, {published} published, {:.1} s", start.elapsed().as_secs_f64());
    for cache in ["cache-1", "cache-2"] {
        folder.attack(&format!("{} --overwrite --cache {cache}", compress("a.ply", 20))).run().succeeded();
        let names = fs::read_dir(folder.path(cache)).unwrap().map(|entry| entry.unwrap().file_name());
        let left: Vec<_> = names.filter(|name| name.to_string_lossy().contains("splatsieve-tmp")).collect();
        assert!(left.is_empty(), "leftovers in {cache}: {left:?}");
    }
    check_no_leftovers(&folder, &foreign_names);
}
