use std::fs::File;

use super::*;

fn write_file(path: &Path, text: &str) {
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent).unwrap();
    }
    fs::write(path, text).unwrap();
}

/// Returns the names of the entries in a folder, sorted.
fn names_in(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn result_folder(path: &Path, content: &str) {
    write_file(&path.join(SUMMARY_FILE), r#"{"tool": "splatsieve 0.1.0", "files": ["content", "summary.json"]}"#);
    write_file(&path.join("content"), content);
}

fn refusal(target: &Path, kind: TargetKind, inputs: &[&Path], replace: Replace) -> String {
    let error = check_target(target, kind, inputs, replace).unwrap_err();
    assert!(matches!(error, Error::Usage(_)), "{error}");
    error.to_string()
}

#[test]
fn a_file_appears_only_at_commit() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out.ply");
    let staged = StagedFile::new(&target, Replace::Never).unwrap();
    fs::write(staged.path(), "new").unwrap();
    assert!(!target.exists());
    staged.commit().unwrap();
    assert_eq!(fs::read_to_string(&target).unwrap(), "new");
    assert_eq!(names_in(base.path()), ["out.ply"]);
}

#[test]
fn dropped_output_leaves_the_old_output() {
    let base = tempfile::tempdir().unwrap();
    let (file, folder) = (base.path().join("out.ply"), base.path().join("out"));
    write_file(&file, "old");
    result_folder(&folder, "old");
    let staged = StagedFile::new(&file, Replace::Existing).unwrap();
    fs::write(staged.path(), "new").unwrap();
    drop(staged);
    let staged = StagedFolder::new(&folder, Replace::Existing).unwrap();
    write_file(&staged.path().join("deep/content"), "new");
    drop(staged);
    assert_eq!(names_in(base.path()), ["out", "out.ply"]);
    assert_eq!(fs::read_to_string(file).unwrap(), "old");
    assert_eq!(fs::read_to_string(folder.join("content")).unwrap(), "old");
}

#[test]
fn existing_target_is_refused_at_start_and_at_commit() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out.ply");
    check_target(&target, TargetKind::File, &[], Replace::Never).unwrap();
    let staged = StagedFile::new(&target, Replace::Never).unwrap();
    fs::write(staged.path(), "new").unwrap();
    write_file(&target, "somebody else's");
    assert!(staged.commit().unwrap_err().to_string().contains("exists already"));
    assert_eq!(fs::read_to_string(&target).unwrap(), "somebody else's");
    assert!(refusal(&target, TargetKind::File, &[], Replace::Never).contains("--overwrite"));
    assert!(StagedFile::new(&target, Replace::Never).is_err());
    check_target(&target, TargetKind::File, &[], Replace::Existing).unwrap();
    assert_eq!(names_in(base.path()), ["out.ply"]);
}

#[test]
fn input_its_parents_and_children_are_never_targets() {
    let base = tempfile::tempdir().unwrap();
    let model = base.path().join("scenes/model");
    let cloud = model.join("point_cloud.ply");
    result_folder(&model, "");
    write_file(&cloud, "");
    for replace in [Replace::Never, Replace::Existing] {
        assert!(refusal(&model, TargetKind::Folder, &[&model], replace).contains("input itself"));
        assert!(refusal(&cloud, TargetKind::File, &[&cloud], replace).contains("input itself"));
        assert!(refusal(&model, TargetKind::Folder, &[&cloud], replace).contains("contains the input"));
        assert!(refusal(&base.path().join("scenes"), TargetKind::Folder, &[&model], replace).contains("contains"));
        let detour = model.join("../../scenes/model");
        assert!(refusal(&detour, TargetKind::Folder, &[&model], replace).contains("input itself"));
        assert!(
            refusal(&model.join("smaller"), TargetKind::Folder, &[&model], replace).contains("lies inside the input")
        );
    }
    // A path whose name only begins with the name of the input is not inside the input.
    check_target(&base.path().join("scenes/model2"), TargetKind::Folder, &[&model], Replace::Never).unwrap();
}

#[cfg(unix)]
#[test]
fn link_to_the_input_is_refused() {
    let base = tempfile::tempdir().unwrap();
    let (model, link) = (base.path().join("model"), base.path().join("link"));
    result_folder(&model, "");
    std::os::unix::fs::symlink(&model, &link).unwrap();
    assert!(refusal(&link, TargetKind::Folder, &[&model], Replace::Existing).contains("input itself"));
    assert!(refusal(&model, TargetKind::Folder, &[&link], Replace::Existing).contains("input itself"));
}

#[test]
fn overwrite_deletes_only_folders_this_program_wrote() {
    let base = tempfile::tempdir().unwrap();
    let home = base.path().join("home");
    write_file(&home.join("thesis.txt"), "years of work");
    assert!(refusal(&home, TargetKind::Folder, &[], Replace::Existing).contains("not a result of splatsieve"));
    let unlisted = r#"{"tool": "splatsieve 0.1.0"}"#;
    for foreign in ["{}", "[]", "no json", r#"{"tool": "another"}"#, r#"{"tool": 1}"#, unlisted] {
        write_file(&home.join(SUMMARY_FILE), foreign);
        assert!(
            refusal(&home, TargetKind::Folder, &[], Replace::Existing).contains("not a result of splatsieve"),
            "{foreign}"
        );
    }
    write_file(&home.join(SUMMARY_FILE), r#"{"tool": "splatsieve 0.1.0", "files": ["summary.json"]}"#);
    check_target(&home, TargetKind::Folder, &[], Replace::Existing).unwrap();
    let empty = base.path().join("empty");
    fs::create_dir(&empty).unwrap();
    check_target(&empty, TargetKind::Folder, &[], Replace::Existing).unwrap();
    assert!(refusal(&home, TargetKind::File, &[], Replace::Existing).contains("is a folder"));
    assert!(refusal(&home.join("thesis.txt"), TargetKind::Folder, &[], Replace::Existing).contains("is no folder"));
}

#[test]
fn folder_that_becomes_foreign_during_the_run_is_kept() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out");
    let staged = StagedFolder::new(&target, Replace::Existing).unwrap();
    result_folder(staged.path(), "new");
    write_file(&target.join("thesis.txt"), "years of work");
    staged.commit().unwrap_err();
    assert_eq!(names_in(&target), ["thesis.txt"]);
    assert_eq!(names_in(base.path()), ["out"]);
}

#[test]
fn a_path_that_does_not_end_in_its_name_is_refused() {
    let base = tempfile::tempdir().unwrap();
    for ending in ["/", "//", "/.", "/./"] {
        let target = base.path().join(format!("out.ply{ending}"));
        let text = refusal(&target, TargetKind::File, &[], Replace::Never);
        assert!(text.contains("found a path that ends in '/'") && text.ends_with("/out.ply"), "{text}");
        let as_folder = check_target(&target, TargetKind::Folder, &[], Replace::Never);
        assert_eq!(as_folder.is_ok(), !ending.contains('.'), "{ending}: {as_folder:?}");
    }
}

#[test]
#[cfg(unix)]
fn a_link_to_a_folder_is_refused_also_with_a_slash_behind_it() {
    let base = tempfile::tempdir().unwrap();
    fs::create_dir(base.path().join("real")).unwrap();
    std::os::unix::fs::symlink("real", base.path().join("link")).unwrap();
    for name in ["link", "link/", "link//"] {
        let target = base.path().join(name);
        assert!(refusal(&target, TargetKind::Folder, &[], Replace::Never).contains("exists already"), "{name}");
        assert!(
            refusal(&target, TargetKind::Folder, &[], Replace::Existing).contains("is a link to a folder"),
            "{name}"
        );
    }
}

#[test]
fn a_name_that_leaves_no_room_for_temporary_names_is_refused() {
    let base = tempfile::tempdir().unwrap();
    for kind in [TargetKind::File, TargetKind::Folder] {
        let target = |length: usize| base.path().join("x".repeat(length));
        check_target(&target(231), kind, &[], Replace::Never).unwrap();
        assert!(refusal(&target(232), kind, &[], Replace::Never).contains("at most 231 bytes"));
    }
    let longest = base.path().join("x".repeat(231));
    let staged = StagedFile::new(&longest, Replace::Never).unwrap();
    fs::write(staged.path(), "content").unwrap();
    staged.commit().unwrap();
    assert_eq!(names_in(base.path()), ["x".repeat(231)]);
}

#[test]
fn a_dash_is_no_name_of_an_output() {
    for kind in [TargetKind::File, TargetKind::Folder] {
        assert!(refusal(Path::new("-"), kind, &[], Replace::Never).contains("stands for standard output"));
    }
}

#[test]
fn impossible_targets_are_refused() {
    let base = tempfile::tempdir().unwrap();
    write_file(&base.path().join("file"), "");
    assert!(
        refusal(&base.path().join("no/such/out"), TargetKind::Folder, &[], Replace::Never).contains("create it first")
    );
    assert!(refusal(&base.path().join("file/out"), TargetKind::File, &[], Replace::Never).contains("is not a folder"));
    for nameless in ["", "/", ".."] {
        assert!(
            refusal(Path::new(nameless), TargetKind::Folder, &[], Replace::Existing)
                .contains("cannot be the name of an output"),
            "{nameless}"
        );
    }
}

/// Creates the workspace (hidden folder) that a killed run leaves beside the target `base/out`: the folder and an
/// unlocked lock file. `random` is the random part of the folder name. Returns the path of the folder.
fn killed_workspace(base: &Path, random: &str) -> PathBuf {
    let folder = base.join(format!(".out.{random}.splatsieve-tmp"));
    write_file(&folder.join("lock"), workspace::LOCK_LINE);
    folder
}

#[test]
fn only_leftovers_of_killed_runs_are_removed() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out");
    write_file(&killed_workspace(base.path(), "dead1").join("content/deep/part"), "half");
    write_file(&killed_workspace(base.path(), "dead2").join("content"), "half");
    fs::create_dir(base.path().join(".out.begun.splatsieve-tmp")).unwrap();
    // A live run that this process can recognize only by its lock, like a run in another container.
    let runs = killed_workspace(base.path(), "alive");
    let lock = File::open(runs.join("lock")).unwrap();
    lock.lock().unwrap();
    write_file(&runs.join("content"), "half");
    // Foreign folders: those of other targets or with other names, and those without the marker line in their lock
    // file.
    let kept = [
        ".other.dead1.splatsieve-tmp/lock",
        ".out.a.b.splatsieve-tmp/lock",
        ".out.x.splatsieve-tmp/no lock",
        ".out.y.splatsieve-tmp/lock",
    ];
    kept.iter().for_each(|name| write_file(&base.path().join(name), ""));
    let first = StagedFolder::new(&target, Replace::Never).unwrap();
    let second = StagedFolder::new(&target, Replace::Never).unwrap();
    assert!(first.path().exists() && second.path().exists() && first.path() != second.path());
    drop((first, second));
    let mut expected: Vec<String> = kept.iter().map(|name| name.split_once('/').unwrap().0.to_owned()).collect();
    expected.push(".out.alive.splatsieve-tmp".to_owned());
    expected.sort();
    assert_eq!(names_in(base.path()), expected);
    drop(lock);
    drop(StagedFile::new(&target, Replace::Never).unwrap());
    assert!(!runs.exists(), "its run has ended now");
}

#[test]
fn run_killed_between_renames_keeps_the_old_output() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out");
    result_folder(&killed_workspace(base.path(), "dead").join("replaced"), "old");
    drop(StagedFolder::new(&target, Replace::Existing).unwrap());
    assert_eq!(names_in(base.path()), ["out"]);
    assert_eq!(fs::read_to_string(target.join("content")).unwrap(), "old");
}

#[test]
fn workspace_with_an_empty_lock_is_removed() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out");
    // State left by a run that was killed after it created the lock file and before it wrote the marker line.
    let workspace = Workspace::beside(&target).unwrap();
    File::create(workspace.folder.join("lock")).unwrap();
    let begun = base.path().join(".out.killed.splatsieve-tmp");
    fs::rename(&workspace.folder, &begun).unwrap();
    drop(workspace);
    assert_eq!(names_in(base.path()), [".out.killed.splatsieve-tmp"]);
    drop(StagedFile::new(&target, Replace::Never).unwrap());
    assert_eq!(names_in(base.path()), [] as [&str; 0]);
}

#[test]
fn run_killed_after_renames_keeps_foreign_files() {
    for (aside, is_carried) in [("replaced", true), ("discarded", false)] {
        let base = tempfile::tempdir().unwrap();
        let target = base.path().join("out");
        result_folder(&target, "new");
        let old = killed_workspace(base.path(), "dead").join(aside);
        result_folder(&old, "old");
        write_file(&old.join("test/one.png"), "precious");
        drop(StagedFolder::new(&target, Replace::Existing).unwrap());
        assert_eq!(names_in(base.path()), ["out"]);
        assert_eq!(fs::read_to_string(target.join("content")).unwrap(), "new");
        assert_eq!(target.join("test/one.png").exists(), is_carried, "{aside}");
    }
}

#[test]
fn foreign_files_in_a_result_are_kept() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out");
    let staged = StagedFolder::new(&target, Replace::Never).unwrap();
    for name in [SUMMARY_FILE, "a/own", "a/b/own", "only/own"] {
        write_file(&staged.path().join(name), r#"{"tool": "splatsieve 0.1.0"}"#);
    }
    staged.commit().unwrap();
    let foreign = ["a/theirs", "a/b/own2", "all/theirs/deep", "file", "folder/theirs", "file in the new one/theirs"];
    foreign.iter().for_each(|name| write_file(&target.join(name), name));
    fs::create_dir(target.join("empty")).unwrap();
    let staged = StagedFolder::new(&target, Replace::Existing).unwrap();
    for name in [SUMMARY_FILE, "a/own", "file", "folder/own", "file in the new one"] {
        write_file(&staged.path().join(name), r#"{"tool": "splatsieve 0.1.0"}"#);
    }
    staged.commit().unwrap();
    let found = ownership::files_below(&target).unwrap();
    assert_eq!(
        found,
        [
            "a/b/own2",
            "a/own",
            "a/theirs",
            "all/theirs/deep",
            "file",
            "file in the new one",
            "file in the new one.kept/theirs",
            "file.kept",
            "folder/own",
            "folder/theirs",
            SUMMARY_FILE
        ]
    );
    assert!(target.join("empty").is_dir() && !target.join("only").exists());
    for name in foreign {
        let kept = found.iter().any(|found| fs::read_to_string(target.join(found)).unwrap() == *name);
        assert!(kept, "{name} is lost");
    }
    assert_eq!(names_in(base.path()), ["out"]);
}

#[test]
fn a_summary_lists_its_files_and_keeps_its_order() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out");
    let staged = StagedFolder::new(&target, Replace::Never).unwrap();
    write_file(&staged.path().join(SUMMARY_FILE), "{\n  \"tool\": \"splatsieve 0.1.0\",\n  \"a\": [1]\n}\n");
    write_file(&staged.path().join("b/\"quoted\""), "");
    staged.commit().unwrap();
    let text = fs::read_to_string(target.join(SUMMARY_FILE)).unwrap();
    let head = "{\n  \"tool\": \"splatsieve 0.1.0\",\n  \"a\": [1],\n  \"files\": [\n";
    assert_eq!(text, format!("{head}    \"b/\\\"quoted\\\"\",\n    \"{SUMMARY_FILE}\"\n  ]\n}}\n"));
    let staged = StagedFolder::new(&base.path().join("broken"), Replace::Never).unwrap();
    write_file(&staged.path().join(SUMMARY_FILE), "no json");
    assert!(staged.commit().unwrap_err().to_string().contains("expected a JSON object"));
    assert_eq!(names_in(base.path()), ["out"]);
}

/// Writes `x.ply` and its two companions under hidden names, and returns the handle that publishes them in `base` with
/// the policy `replace`. The output and one companion hold `text`; the other companion is a summary.
fn stage_set(base: &Path, text: &str, replace: Replace) -> Result<StagedFile> {
    let companions = ["x.ply.summary.json", "x.ply.recipe.toml"].map(|name| base.join(name)).to_vec();
    let staged = StagedFile::with_companions(&base.join("x.ply"), companions, replace)?;
    write_file(staged.path(), text);
    write_file(&staged.companion_path(0), r#"{"tool": "splatsieve 0.1.0"}"#);
    write_file(&staged.companion_path(1), text);
    Ok(staged)
}

#[test]
fn overwriting_a_file_replaces_it_with_its_companions() {
    let base = tempfile::tempdir().unwrap();
    write_file(&base.path().join("x.ply"), "written by another program");
    write_file(&base.path().join("x.ply.notes"), "precious");
    stage_set(base.path(), "new", Replace::Existing).unwrap().commit().unwrap();
    assert_eq!(names_in(base.path()), ["x.ply", "x.ply.notes", "x.ply.recipe.toml", "x.ply.summary.json"]);
    assert_eq!(fs::read_to_string(base.path().join("x.ply")).unwrap(), "new");
    assert_eq!(fs::read_to_string(base.path().join("x.ply.notes")).unwrap(), "precious");
}

/// Creates in `base` the files that a run leaves if it is killed while it renames `x.ply` and two companions to their
/// final names. `published` is the number of files that already have their final names, and `replace` is the policy of
/// the run for existing files.
fn leave_half_published(base: &Path, published: usize, replace: Replace) {
    let left = base.join(".x.ply.dead.splatsieve-tmp");
    write_file(&left.join("lock"), workspace::LOCK_LINE);
    let files = [("a", "x.ply.recipe.toml"), ("b", "x.ply.summary.json"), ("content", "x.ply")];
    for (index, (content, name)) in files.iter().enumerate() {
        write_file(&if index < published { base.join(name) } else { left.join(content) }, "of the killed run");
    }
    let files = files.map(|(content, name)| (content.to_owned(), name.into())).to_vec();
    let journal = serde_json::to_string(&leftovers::PublicationJournal { replace, files }).unwrap();
    write_file(&left.join("journal"), &journal);
}

#[test]
fn a_killed_publication_is_completed_by_the_next_run() {
    for published in 0..=3 {
        let base = tempfile::tempdir().unwrap();
        leave_half_published(base.path(), published, Replace::Never);
        assert!(refusal(&base.path().join("x.ply"), TargetKind::File, &[], Replace::Never).contains("exists already"));
        assert_eq!(names_in(base.path()), ["x.ply", "x.ply.recipe.toml", "x.ply.summary.json"]);
        for name in names_in(base.path()) {
            assert_eq!(fs::read_to_string(base.path().join(name)).unwrap(), "of the killed run");
        }
    }
}

#[test]
fn a_killed_publication_is_never_completed_over_a_later_one() {
    let base = tempfile::tempdir().unwrap();
    let staged = stage_set(base.path(), "new", Replace::Existing).unwrap();
    leave_half_published(base.path(), 1, Replace::Existing);
    staged.commit().unwrap();
    check_target(&base.path().join("x.ply"), TargetKind::File, &[], Replace::Existing).unwrap();
    assert_eq!(names_in(base.path()), ["x.ply", "x.ply.recipe.toml", "x.ply.summary.json"]);
    assert_eq!(fs::read_to_string(base.path().join("x.ply")).unwrap(), "new");
    assert_eq!(fs::read_to_string(base.path().join("x.ply.recipe.toml")).unwrap(), "new");
}

#[test]
fn a_killed_publication_does_not_replace_a_file_that_came_later() {
    let base = tempfile::tempdir().unwrap();
    leave_half_published(base.path(), 1, Replace::Never);
    write_file(&base.path().join("x.ply"), "precious");
    refusal(&base.path().join("x.ply"), TargetKind::File, &[], Replace::Never);
    assert_eq!(fs::read_to_string(base.path().join("x.ply")).unwrap(), "precious");
    assert!(take_warnings().iter().any(|warning| warning.contains("could not be repaired")));
}

#[test]
fn only_one_of_two_runs_publishes() {
    let base = tempfile::tempdir().unwrap();
    let staged = [0, 1].map(|run| stage_set(base.path(), &run.to_string(), Replace::Never).unwrap());
    let mut done = 0;
    std::thread::scope(|scope| {
        let threads = staged.map(|staged| scope.spawn(move || staged.commit().is_ok()));
        done = threads.into_iter().map(|thread| usize::from(thread.join().unwrap())).sum();
    });
    assert_eq!(done, 1);
    let text = |name: &str| fs::read_to_string(base.path().join(name)).unwrap();
    assert_eq!(text("x.ply"), text("x.ply.recipe.toml"));
}

#[test]
fn a_summary_larger_than_the_limit_is_not_read() {
    let base = tempfile::tempdir().unwrap();
    let path = base.path().join("summary.json");
    write_file(&path, r#"{"tool": "splatsieve 0.1.0", "files": ["a"]}"#);
    assert!(matches!(ownership::ListedFiles::read(&path), ownership::ListedFiles::Listed(_)));
    File::options().write(true).open(&path).unwrap().set_len(3 << 30).unwrap();
    assert_eq!(ownership::ListedFiles::read(&path), ownership::ListedFiles::Unknown);
}

#[test]
fn bare_name_is_written_to_the_working_folder() {
    assert_eq!(split_target(Path::new("out")).unwrap(), (PathBuf::from("."), "out".as_ref()));
}
