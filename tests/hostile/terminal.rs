//! Tests of three dangers: standard streams that cannot be written; names and texts that a terminal, a spreadsheet or a
//! browser would execute; outputs that would reveal folder names of the machine.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::Read;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Stdio;

use serde_json::Value;

use crate::runner::{Attack, Folder, Outcome, full_device, tiny_model};

/// Options that make a run on the tiny model short.
const SHORT: &str = "--no-refine --prune-only --ratio 0.5";

#[test]
fn the_runner_reports_code_message_and_memory() {
    let folder = Folder::new();
    let outcome = folder.attack("info missing.gseq").run().refused(1, &["missing.gseq"]);
    assert!(outcome.peak_bytes > 1 << 20 && outcome.seconds > 0.0);
    let outcome = folder.attack("recipe").run().succeeded();
    assert!(outcome.stdout.contains('='));
}

/// Standard stream that accepts no more bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
enum BrokenStream {
    /// Device without free space.
    Full,
    /// Pipe whose reader has ended.
    Unread,
    /// Descriptor that is closed when the program starts.
    Closed,
    /// Terminal whose window has been closed.
    HungUp,
}

const BROKEN_STREAMS: [BrokenStream; 4] =
    [BrokenStream::Full, BrokenStream::Unread, BrokenStream::Closed, BrokenStream::HungUp];

impl BrokenStream {
    /// Replaces a standard stream of a run by this broken stream. `descriptor` is 1 for standard output and 2 for
    /// standard error.
    fn replace_stream(self, attack: Attack, descriptor: i32) -> Attack {
        let stream: Stdio = match self {
            BrokenStream::Full => full_device().into(),
            BrokenStream::Unread => std::io::pipe().unwrap().1.into(),
            BrokenStream::Closed => Stdio::null(),
            BrokenStream::HungUp => terminal().1.into(),
        };
        let attack = if descriptor == 1 { attack.stdout(stream) } else { attack.stderr(stream) };
        if self != BrokenStream::Closed {
            return attack;
        }
        attack.with(|command| {
            // SAFETY: close may be called between fork and exec, and the descriptor is the child's own.
            unsafe {
                command.pre_exec(move || {
                    libc::close(descriptor);
                    Ok(())
                })
            };
        })
    }
}

/// Opens a new pseudo-terminal. Returns its two ends: that of the terminal window, and that of the program. Both have
/// the flag close-on-exec: a copy in a process that another test starts at the same time would keep the window open.
fn terminal() -> (OwnedFd, OwnedFd) {
    let window: OwnedFd = File::options().read(true).write(true).open("/dev/ptmx").expect("no terminal").into();
    let flags = libc::O_RDWR | libc::O_NOCTTY | libc::O_CLOEXEC;
    // SAFETY: unlockpt and this request take an open descriptor and no pointer.
    let program = unsafe {
        assert_eq!(libc::unlockpt(window.as_raw_fd()), 0, "the terminal is locked");
        libc::ioctl(window.as_raw_fd(), libc::TIOCGPTPEER, flags)
    };
    assert!(program >= 0, "no end of the terminal for the program");
    // SAFETY: the request has just opened the descriptor, and nothing else owns it.
    (window, unsafe { OwnedFd::from_raw_fd(program) })
}

/// Quick commands that print something, each with its exit code.
const QUICK: [(&str, i32); 10] = [
    ("--help", 0),
    ("compress --help", 0),
    ("--version", 0),
    ("recipe", 0),
    ("completions bash", 0),
    ("info {tiny}", 0),
    ("info {tiny} --json", 0),
    ("compress {tiny} -o small --dry-run", 0),
    ("info missing.gseq", 1),
    ("compress", 2),
];

/// Checks that a command with a broken standard error ends with the exit code `code`, as without the defect.
fn check_broken_stderr(folder: &Folder, arguments: &str, code: i32) {
    for broken in BROKEN_STREAMS {
        let outcome = broken.replace_stream(folder.attack(arguments), 2).run().ended();
        assert_eq!(outcome.code, Some(code), "{arguments}, standard error {broken:?}");
    }
}

/// Checks that a command with a broken standard output fails, except if its reader has ended. A stream that is closed
/// when the program starts becomes the null device, because the start code of the operating system opens it there.
fn check_broken_stdout(folder: &Folder, arguments: &str) {
    for broken in BROKEN_STREAMS {
        let outcome = broken.replace_stream(folder.attack(arguments), 1).run().ended();
        match broken {
            BrokenStream::Full => drop(outcome.refused(1, &["cannot write standard output: No space left"])),
            BrokenStream::HungUp => drop(outcome.refused(1, &["cannot write standard output"])),
            BrokenStream::Closed => drop(outcome.succeeded()),
            BrokenStream::Unread => {
                let outcome = outcome.succeeded();
                assert!(!outcome.stderr.contains("standard output"), "{arguments}\n{}", outcome.stderr);
            }
        }
    }
}

#[test]
fn broken_standard_error_changes_no_exit_code() {
    let folder = Folder::new();
    for (arguments, code) in QUICK {
        check_broken_stderr(&folder, arguments, code);
    }
}

#[test]
fn broken_standard_output_is_an_error() {
    let folder = Folder::new();
    for (arguments, _) in QUICK.into_iter().filter(|(_, code)| *code == 0) {
        check_broken_stdout(&folder, arguments);
    }
    let outcome = folder.attack("recipe").stdout(full_device()).stderr(full_device()).run().ended();
    assert_eq!(outcome.code, Some(1));
}

#[test]
fn run_with_broken_streams_writes_its_whole_result() {
    let folder = Folder::new();
    let line = format!("compress {{tiny}} --cameras {{tiny}} {SHORT} --explain -o");
    folder.attack(&format!("{line} full --view")).stderr(full_device()).run().succeeded();
    assert!(folder.path("full/summary.json").is_file());
    let unread = BrokenStream::Unread
        .replace_stream(BrokenStream::HungUp.replace_stream(folder.attack(&format!("{line} unread --view")), 2), 1);
    unread.run().succeeded();
    assert!(folder.path("unread/summary.json").is_file());
    // The page was asked for, so it is written even if the summary cannot be printed.
    assert!(folder.path("unread.html").is_file());
    assert_eq!(folder.names(), ["full", "full.html", "unread", "unread.html"]);
}

#[test]
#[ignore = "slow: every command with every broken stream"]
fn slow_every_command_survives_broken_streams() {
    let folder = Folder::new();
    folder.attack("convert {tiny} scene.gseq --cameras {tiny}").run().succeeded();
    folder.attack(&format!("compress {{tiny}} --cameras {{tiny}} {SHORT} -o small")).run().succeeded();
    folder.attack("convert {tiny} frames --cameras {tiny} --as ply-sequence").run().succeeded();
    let commands = [
        format!("compress {{tiny}} --cameras {{tiny}} {SHORT} -o out --overwrite --explain"),
        format!("compress {{tiny}} --cameras {{tiny}} {SHORT} -o out --overwrite --json"),
        "compress {tiny} --cameras {tiny} --dry-run=stages -o out --overwrite".to_owned(),
        "score {tiny} --cameras {tiny} -o out.csv --overwrite".to_owned(),
        "render {tiny} --cameras {tiny} --view 0 --frame 0 -o out.png --overwrite".to_owned(),
        "render {tiny} --cameras {tiny} --view 0 --video out.gif --overwrite".to_owned(),
        "evaluate {tiny} small --cameras {tiny} --max-frames 2".to_owned(),
        "evaluate {tiny} small --cameras {tiny} --max-frames 2 --json --csv out.csv --overwrite".to_owned(),
        "report {tiny} small --cameras {tiny} --max-frames 2 -o out --overwrite".to_owned(),
        "sweep {tiny} --cameras {tiny} -o out --overwrite --methods random --fractions 0.5 --max-frames 1".to_owned(),
        "view {tiny} small --cameras {tiny} -o out.html --overwrite".to_owned(),
        "convert frames/frame_00000.ply out.spz --overwrite".to_owned(),
        "convert {tiny} out.gseq --cameras {tiny} --overwrite --json".to_owned(),
        "convert {tiny} out.gseq --cameras {tiny} --overwrite".to_owned(),
        "info scene.gseq".to_owned(),
        "info scene.gseq --check --json".to_owned(),
        "convert scene.gseq out --as ply-sequence --overwrite".to_owned(),
        "convert scene.gseq -".to_owned(),
        "info scene.gseq --repair out.gseq --overwrite".to_owned(),
        "test-scene --gaussians 100 --frames 1 --no-refine".to_owned(),
        "selfcheck --json".to_owned(),
        "man pages".to_owned(),
    ];
    for arguments in &commands {
        check_broken_stderr(&folder, arguments, 0);
        // A frame stream behaves like text: it ends without an error if the reader ends, and a full device is an error.
        check_broken_stdout(&folder, arguments);
    }
}

/// Characters of a name that must not reach a terminal: escape sequences of both sets, line ends, marks of text
/// direction.
const EVIL: &str = "a\u{1b}[31m\u{9b}2J\u{1b}]0;x\u{7}\r\nsplatsieve: b\u{202e}c\u{61c}\u{7f}";

/// Checks that the output of a run is safe for a terminal, and that no part of a name appears as a line of its own.
fn check_printable(outcome: &Outcome) {
    let is_evil = |c: char| {
        c != '\n' && (c.is_control() || matches!(c, '\u{61c}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}'))
    };
    for text in [&outcome.stdout, &outcome.stderr] {
        assert!(!text.contains(is_evil), "{}: {text:?}", outcome.shown);
        assert!(!text.lines().any(|line| line.starts_with("splatsieve: b")), "{}: {text:?}", outcome.shown);
    }
}

/// Runs the program with the arguments `words`, which may contain any characters.
fn run_words(folder: &Folder, words: &[&str]) -> Outcome {
    folder.attack_with(words.iter().map(OsString::from)).run().ended()
}

#[test]
fn names_in_messages_cannot_control_a_terminal() {
    let folder = Folder::new();
    let in_folder = format!("{EVIL}/{EVIL}.ply");
    let tiny = tiny_model();
    let tiny = tiny.to_str().unwrap();
    let message = run_words(&folder, &["info", EVIL]).stderr;
    assert!(message.contains("cannot open a<U+001B>[31m<U+009B>2J"), "{message}");
    for words in [
        &["info", EVIL][..],
        &["info", &in_folder],
        &["info", EVIL, "--check"],
        &["info", EVIL, "--repair", EVIL],
        &["compress", EVIL, "-o", "small"],
        &["compress", tiny, "-o", &in_folder],
        &["compress", "x", "--recipe", EVIL, "-o", "y"],
        &["compress", "x", "-o", "y", "--keep-ids", EVIL],
        &["evaluate", EVIL, EVIL, "--cameras", EVIL],
        &["view", EVIL, "-o", "x.html"],
        &["work", EVIL],
        // Messages of the argument parser.
        &[EVIL],
        &["info", "x", EVIL],
        &["recipe", EVIL],
        &["compress", "x", "-o", "y", "--ratio", EVIL],
    ] {
        let outcome = run_words(&folder, words);
        assert!(matches!(outcome.code, Some(1 | 2)), "{words:?}: {:?}", outcome.code);
        check_printable(&outcome);
    }
}

#[test]
fn names_in_results_cannot_control_a_terminal() {
    let folder = Folder::new();
    let model = folder.path(EVIL);
    copy(&tiny_model(), &model);
    let cameras = tiny_model();
    let cameras = cameras.to_str().unwrap();
    let outcome = run_words(&folder, &["info", EVIL]);
    assert!(
        outcome.stdout.contains("a<U+001B>[31m<U+009B>2J<U+001B>]0;x<U+0007><U+000D><U+000A>splatsieve: b<U+202E>c")
    );
    check_printable(&outcome.succeeded());
    let outcome = run_words(&folder, &["info", EVIL, "--json"]).succeeded();
    check_printable(&outcome);
    let told: Value = serde_json::from_str(&outcome.stdout).unwrap();
    assert_eq!(told["path"], EVIL);
    let small = format!("{EVIL}-small");
    let short: Vec<&str> = SHORT.split(' ').collect();
    let compress =
        [&["compress", EVIL, "--cameras", cameras, "--verbose", "--explain", "-o", &small][..], &short].concat();
    check_printable(&run_words(&folder, &compress).succeeded());
    let evaluate = ["evaluate", EVIL, &small, "--cameras", cameras, "--max-frames", "1"];
    check_printable(&run_words(&folder, &evaluate).succeeded());
}

/// Copies a folder with its contents.
fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target)
        } else {
            assert!(fs::copy(entry.path(), target).is_ok())
        }
    }
}

/// Folder name that no output may contain.
const SECRET: &str = "secret_client_name";

/// Folder below a folder named [`SECRET`], with a copy of the tiny model that looks as if it was trained there: its
/// `cfg_args` contains the name too.
struct Secret {
    _top: Folder,
    place: PathBuf,
}

impl Secret {
    fn new() -> Secret {
        let top = Folder::new();
        let place = top.path(SECRET);
        let model = place.join("model");
        copy(&tiny_model(), &model);
        let config = fs::read_to_string(model.join("cfg_args")).unwrap();
        let trained = config.replace("source_path='tiny_model'", &format!("source_path='{}'", model.display()));
        assert!(trained != config);
        fs::write(model.join("cfg_args"), trained).unwrap();
        fs::create_dir(place.join("out")).unwrap();
        Secret { _top: top, place }
    }

    /// Runs the program with absolute paths. In `arguments`, `{m}` stands for the model and `{o}` for the folder of
    /// outputs.
    fn run(&self, arguments: &str) -> Outcome {
        let [model, out] = ["model", "out"].map(|name| self.place.join(name).display().to_string());
        let words = arguments.split(' ').map(|word| word.replace("{m}", &model).replace("{o}", &out));
        // The working directory does not reveal the folder either.
        self._top.attack_with(words).within(300.0).run().succeeded()
    }

    /// Checks that no output contains the folder name [`SECRET`], not even inside compressed data. With
    /// `may_hold_config`, copies of the user's own `cfg_args` are excepted.
    fn check(&self, may_hold_config: bool) {
        let mut files = Vec::new();
        list(&self.place.join("out"), &mut files);
        assert!(files.len() > 2, "{files:?}");
        for file in files {
            let bytes = fs::read(&file).unwrap();
            let is_config = may_hold_config && file.ends_with("cfg_args");
            let found = [vec![bytes.clone()], decompressed(&bytes)].concat();
            let tells = found.iter().any(|bytes| holds(bytes, SECRET.as_bytes()));
            assert!(!tells || is_config, "{} names the folder", file.display());
        }
    }
}

fn holds(bytes: &[u8], part: &[u8]) -> bool {
    bytes.windows(part.len()).any(|window| window == part)
}

fn list(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() { list(&path, files) } else { files.push(path) }
    }
}

/// Returns the decompressed contents of every Zstandard frame and zlib stream in `bytes`.
fn decompressed(bytes: &[u8]) -> Vec<Vec<u8>> {
    let mut found = Vec::new();
    for at in 0..bytes.len().saturating_sub(4) {
        let mut out = Vec::new();
        if bytes[at..].starts_with(&[0x28, 0xb5, 0x2f, 0xfd])
            && let Ok(decoder) = zstd::Decoder::new(&bytes[at..])
        {
            let _ = decoder.single_frame().take(1 << 24).read_to_end(&mut out);
        } else if matches!(bytes[at..], [0x78, 0x01 | 0x5e | 0x9c | 0xda, ..]) {
            let _ = flate2::read::ZlibDecoder::new(&bytes[at..]).take(1 << 16).read_to_end(&mut out);
        }
        found.extend((!out.is_empty()).then_some(out));
    }
    found
}

#[test]
fn outputs_contain_no_folder_names_of_the_machine() {
    let secret = Secret::new();
    secret.run(&format!("compress {{m}} --cameras {{m}} {SHORT} -o {{o}}/small"));
    secret.run("render {m} --cameras {m} --frame 0 --view 0 -o {o}/render.png");
    secret.run("convert {m} {o}/frames --cameras {m} --as ply-sequence");
    secret.check(true);
    let recipe = fs::read_to_string(secret.place.join("out/small/recipe.toml")).unwrap();
    assert!(recipe.contains("cameras = \"../../model\""), "{recipe}");
    let summary: Value =
        serde_json::from_slice(&fs::read(secret.place.join("out/small/summary.json")).unwrap()).unwrap();
    assert_eq!((&summary["input"]["path"], &summary["output"]), (&"model".into(), &"small".into()));
}

#[test]
#[ignore = "slow: every command that writes"]
fn slow_outputs_of_all_commands_contain_no_folder_names() {
    let secret = Secret::new();
    for arguments in [
        "compress {m} --cameras {m} SHORT -o {o}/small --view --cache {m}/../work",
        "compress {m} --cameras {m} SHORT -o {o}/small.gseq",
        "compress {m} --cameras {m} SHORT -o {o}/small.splatv",
        "compress {m} --cameras {m} SHORT -o {o}/small.4dgs",
        "compress {m} --cameras {m} SHORT -o {o}/few --as ply-sequence",
        "test-scene -o {o}/test-scene --gaussians 100 --frames 2 --no-refine",
        "convert {m} {o}/scene.splatv --cameras {m}",
        "convert {m} {o}/scene.4dgs --cameras {m}",
        "convert {m} {o}/frames --cameras {m} --as ply-sequence",
        "convert {o}/frames/frame_00000.ply {o}/one.spz",
        "compress {o}/frames/frame_00000.ply SHORT --archive-psnr 30 -o {o}/one.gsz",
        "convert {m} {o}/scene.gseq --cameras {m}",
        "convert {o}/frames {o}/frames.gseq",
        "info {o}/scene.gseq --repair {o}/recovered.gseq",
        "score {m} --cameras {m} -o {o}/rows.npz",
        "score {m} --cameras {m} -o {o}/rows.csv",
        "render {m} --cameras {m} --all -o {o}/photos",
        "render {m} --cameras {m} --view 0 --video {o}/film.gif",
        "render {m} --cameras {m} --view 0 --video {o}/film.png --beside {o}/small",
        "compress {m} --cameras {m} --no-refine --max-loss 9dB --ground-truth {o}/photos -o {o}/goal",
        "evaluate {m} {o}/small --cameras {m} --csv {o}/scores.csv",
        "sweep {m} --cameras {m} -o {o}/curves --fractions 0.5 --methods default,random --max-frames 1 --steps 2 --steps-at 0.5",
        "precision {m} --cameras {m} -o {o}/diagrams --knobs scoring --max-frames 1 --repeat 1",
        "report {m} {o}/small --cameras {m} --ground-truth {o}/photos --sweep {o}/curves/sweep.json \
         --precision {o}/diagrams/precision.json -o {o}/report",
        "view {m} {o}/small --cameras {m} -o {o}/scene.html",
        "view {m} {o}/small --cameras {m} -o {o}/scene",
        "man {o}/man",
    ] {
        secret.run(&arguments.replace("SHORT", SHORT));
    }
    secret.check(true);
}

#[test]
#[ignore = "slow: archives of the tiny model"]
fn slow_archives_contain_no_folder_names_of_training() {
    let secret = Secret::new();
    secret.run(&format!("compress {{m}} --cameras {{m}} {SHORT} --archive-psnr 30 -o {{o}}/small.gsz"));
    secret.run("convert {o}/small.gsz {o}/small");
    secret.check(false);
    let config = fs::read_to_string(secret.place.join("out/small/cfg_args")).unwrap();
    assert!(config.contains("source_path='model', model_path='tiny'"), "{config}");
    secret.run("info {o}/small");
    // The unpacked folder loads, and finds the cameras of a folder of that name beside it.
    secret.run("render {o}/small --cameras {m} --frame 0 --view 0 -o {o}/render.png");
}

#[test]
fn recipe_repeats_its_run_after_moving_all_files() {
    let top = Folder::new();
    let [first, second] = ["first", "second/place"].map(|name| top.path(name));
    copy(&tiny_model(), &first.join("model"));
    let run = |place: &Path, words: &str| {
        let line = format!("compress model {words}");
        top.attack_with(line.split(' ')).with(|command| _ = command.current_dir(place)).run().ended()
    };
    run(&first, &format!("--cameras model {SHORT} -o small")).succeeded();
    copy(&first, &second);
    fs::remove_dir_all(&first).unwrap();
    run(&second, "--recipe small/recipe.toml -o again").succeeded();
    for name in ["recipe.toml", "index_map.npy", "cfg_args"] {
        let [before, after] = ["small", "again"].map(|result| fs::read(second.join(result).join(name)).unwrap());
        assert!(before == after, "{name} differs");
    }
    // The recipe names a file that does not exist.
    fs::create_dir(top.path("third")).unwrap();
    copy(&second.join("model"), &top.path("third/model"));
    fs::copy(second.join("small/recipe.toml"), top.path("recipe.toml")).unwrap();
    run(&top.path("third"), "--recipe ../recipe.toml -o again").refused(2, &["recipe.toml", "cameras", "--cameras"]);
    run(&top.path("third"), "--recipe ../recipe.toml --cameras model --dry-run -o again").succeeded();
}

#[test]
fn manual_pages_are_written_all_or_none() {
    let folder = Folder::new();
    let limited = |arguments: &str| {
        folder.attack(arguments).with(|command| {
            // SAFETY: setrlimit and signal may be called between fork and exec; the limit lives on the stack.
            unsafe {
                command.pre_exec(|| {
                    let limit = libc::rlimit { rlim_cur: 4000, rlim_max: 4000 };
                    libc::setrlimit(libc::RLIMIT_FSIZE, &limit);
                    libc::signal(libc::SIGXFSZ, libc::SIG_IGN);
                    Ok(())
                })
            };
        })
    };
    limited("man share/man/man1").run().refused(1, &["cannot write"]);
    assert_eq!(folder.names(), [""; 0]);
    folder.write("man1/other.1", "mine");
    limited("man man1").run().refused(1, &["cannot write"]);
    assert_eq!(fs::read_dir(folder.path("man1")).unwrap().count(), 1);
    folder.write("man1/splatsieve.1", "precious");
    folder.attack("man man1").run().refused(2, &["splatsieve.1", "something else"]);
    fs::remove_file(folder.path("man1/splatsieve.1")).unwrap();
    for _ in 0..2 {
        folder.attack("man man1").run().succeeded();
    }
    assert_eq!(fs::read_to_string(folder.path("man1/other.1")).unwrap(), "mine");
    let page = fs::read_to_string(folder.path("man1/splatsieve-compress.1")).unwrap();
    assert!(page.contains(".SH EXAMPLES"));
    folder.attack("man share/man/man1").run().succeeded();
    assert!(folder.path("share/man/man1/splatsieve.1").is_file());
}

#[test]
fn pages_run_only_their_own_scripts() {
    let folder = Folder::new();
    let name = "<script>x=1<img src=x onerror=x()>";
    copy(&tiny_model(), &folder.path(name));
    let tiny = tiny_model();
    let cameras = tiny.to_str().unwrap();
    run_words(&folder, &["view", name, "--cameras", cameras, "-o", "page.html", "--max-frames", "2"]).succeeded();
    run_words(&folder, &["view", name, "--cameras", cameras, "-o", "pages", "--max-frames", "2"]).succeeded();
    for (page, scripts) in [("page.html", 4), ("pages/index.html", 2)] {
        let text = fs::read_to_string(folder.path(page)).unwrap();
        let (_, rest) = text.split_once("<meta http-equiv=\"Content-Security-Policy\" content=\"").unwrap();
        let policy = rest.split_once('"').unwrap().0;
        assert!(policy.starts_with("default-src 'none'; base-uri 'none'; form-action 'none'"), "{policy}");
        assert!(!policy.contains("unsafe") && !policy.contains("http"), "{policy}");
        // The policy names every script, and no element has an event handler.
        assert_eq!(text.matches("<script>").count(), scripts, "{page}");
        let sources = policy.split_once("script-src ").unwrap().1;
        let named = sources.matches("'sha256-").count();
        assert_eq!(named, scripts, "{policy}");
        assert!(!text.contains("onerror=x()>") || text.contains("\\u003cimg"), "{page}");
        assert!(!text.contains(" onsubmit=") && !text.contains(" onclick="), "{page}");
    }
}

#[test]
fn full_device_takes_no_bytes() {
    use std::io::Write;
    let mut full: File = full_device();
    assert!(full.write_all(b"x").is_err(), "attacks on full streams would test nothing");
}
