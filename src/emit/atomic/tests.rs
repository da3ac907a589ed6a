use super::*;

fn put(path: &Path, text: &str) {
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent).unwrap();
    }
    fs::write(path, text).unwrap();
}

/// Names in a folder, sorted.
fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn result_folder(path: &Path, content: &str) {
    put(&path.join(MARKER), r#"{"tool": "splatsieve 0.1.0"}"#);
    put(&path.join("content"), content);
}

fn refusal(target: &Path, kind: Kind, inputs: &[&Path], overwrite: bool) -> String {
    let error = check_target(target, kind, inputs, overwrite).unwrap_err();
    assert!(matches!(error, Error::Usage(_)), "{error}");
    error.to_string()
}

#[test]
fn a_file_appears_only_at_commit() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out.ply");
    let staged = StagedFile::new(&target, false).unwrap();
    fs::write(staged.path(), "new").unwrap();
    assert!(!target.exists());
    staged.commit().unwrap();
    assert_eq!(fs::read_to_string(&target).unwrap(), "new");
    assert_eq!(names(base.path()), ["out.ply"]);
}

#[test]
fn what_is_dropped_leaves_nothing_and_the_old_output_whole() {
    let base = tempfile::tempdir().unwrap();
    let (file, folder) = (base.path().join("out.ply"), base.path().join("out"));
    put(&file, "old");
    result_folder(&folder, "old");
    let staged = StagedFile::new(&file, true).unwrap();
    fs::write(staged.path(), "new").unwrap();
    drop(staged);
    let staged = StagedFolder::new(&folder, true).unwrap();
    put(&staged.path().join("deep/content"), "new");
    drop(staged);
    assert_eq!(names(base.path()), ["out", "out.ply"]);
    assert_eq!(fs::read_to_string(file).unwrap(), "old");
    assert_eq!(fs::read_to_string(folder.join("content")).unwrap(), "old");
}

#[test]
fn overwriting_replaces_the_whole_folder() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out");
    result_folder(&target, "old");
    put(&target.join("only in the old one"), "");
    check_target(&target, Kind::Folder, &[], true).unwrap();
    let staged = StagedFolder::new(&target, true).unwrap();
    result_folder(staged.path(), "new");
    staged.commit().unwrap();
    assert_eq!(names(&target), ["content", MARKER]);
    assert_eq!(fs::read_to_string(target.join("content")).unwrap(), "new");
    assert_eq!(names(base.path()), ["out"]);
}

#[test]
fn an_existing_target_is_refused_before_work_and_again_at_commit() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out.ply");
    check_target(&target, Kind::File, &[], false).unwrap();
    let staged = StagedFile::new(&target, false).unwrap();
    fs::write(staged.path(), "new").unwrap();
    put(&target, "somebody else's");
    assert!(staged.commit().unwrap_err().to_string().contains("exists already"));
    assert_eq!(fs::read_to_string(&target).unwrap(), "somebody else's");
    assert!(refusal(&target, Kind::File, &[], false).contains("--overwrite"));
    assert!(StagedFile::new(&target, false).is_err());
    check_target(&target, Kind::File, &[], true).unwrap();
    assert_eq!(names(base.path()), ["out.ply"]);
}

#[test]
fn the_input_what_holds_it_and_what_lies_in_it_are_never_a_target() {
    let base = tempfile::tempdir().unwrap();
    let model = base.path().join("scenes/model");
    let cloud = model.join("point_cloud.ply");
    result_folder(&model, "");
    put(&cloud, "");
    for overwrite in [false, true] {
        assert!(refusal(&model, Kind::Folder, &[&model], overwrite).contains("input itself"));
        assert!(refusal(&cloud, Kind::File, &[&cloud], overwrite).contains("input itself"));
        assert!(refusal(&model, Kind::Folder, &[&cloud], overwrite).contains("contains the input"));
        assert!(refusal(&base.path().join("scenes"), Kind::Folder, &[&model], overwrite).contains("contains"));
        let detour = model.join("../../scenes/model");
        assert!(refusal(&detour, Kind::Folder, &[&model], overwrite).contains("input itself"));
        assert!(refusal(&model.join("smaller"), Kind::Folder, &[&model], overwrite).contains("lies inside the input"));
    }
    // A name that merely starts like the input's is another one.
    check_target(&base.path().join("scenes/model2"), Kind::Folder, &[&model], false).unwrap();
}

#[cfg(unix)]
#[test]
fn a_link_to_the_input_is_the_input() {
    let base = tempfile::tempdir().unwrap();
    let (model, link) = (base.path().join("model"), base.path().join("link"));
    result_folder(&model, "");
    std::os::unix::fs::symlink(&model, &link).unwrap();
    assert!(refusal(&link, Kind::Folder, &[&model], true).contains("input itself"));
    assert!(refusal(&model, Kind::Folder, &[&link], true).contains("input itself"));
}

#[test]
fn overwrite_deletes_only_folders_this_program_wrote() {
    let base = tempfile::tempdir().unwrap();
    let home = base.path().join("home");
    put(&home.join("thesis.txt"), "years of work");
    assert!(refusal(&home, Kind::Folder, &[], true).contains("not a result of splatsieve"));
    for foreign in ["{}", "[]", "no json", r#"{"tool": "another"}"#, r#"{"tool": 1}"#] {
        put(&home.join(MARKER), foreign);
        assert!(refusal(&home, Kind::Folder, &[], true).contains("not a result of splatsieve"), "{foreign}");
    }
    put(&home.join(MARKER), r#"{"tool": "splatsieve 0.1.0"}"#);
    check_target(&home, Kind::Folder, &[], true).unwrap();
    let empty = base.path().join("empty");
    fs::create_dir(&empty).unwrap();
    check_target(&empty, Kind::Folder, &[], true).unwrap();
    assert!(refusal(&home, Kind::File, &[], true).contains("is a folder"));
    assert!(refusal(&home.join("thesis.txt"), Kind::Folder, &[], true).contains("is no folder"));
}

#[test]
fn a_folder_that_became_foreign_during_the_run_is_left_alone() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out");
    let staged = StagedFolder::new(&target, true).unwrap();
    result_folder(staged.path(), "new");
    put(&target.join("thesis.txt"), "years of work");
    staged.commit().unwrap_err();
    assert_eq!(names(&target), ["thesis.txt"]);
    assert_eq!(names(base.path()), ["out"]);
}

#[test]
fn impossible_targets_are_refused() {
    let base = tempfile::tempdir().unwrap();
    put(&base.path().join("file"), "");
    assert!(refusal(&base.path().join("no/such/out"), Kind::Folder, &[], false).contains("create it first"));
    assert!(refusal(&base.path().join("file/out"), Kind::File, &[], false).contains("is not a folder"));
    for nameless in ["", "/", ".."] {
        assert!(refusal(Path::new(nameless), Kind::Folder, &[], true).contains("no name"), "{nameless}");
    }
}

/// The number of a process that has ended.
#[cfg(target_os = "linux")]
fn ended() -> u32 {
    let mut child = process::Command::new("true").spawn().unwrap();
    child.wait().unwrap();
    child.id()
}

#[cfg(target_os = "linux")]
#[test]
fn leftovers_of_killed_runs_go_and_those_of_running_ones_stay() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out");
    let dead = ended();
    put(&base.path().join(format!(".out.{dead}-0.{WRITING}/deep/part")), "half");
    put(&base.path().join(format!(".out.{dead}-1.{WRITING}")), "half");
    let kept = [
        format!(".other.{dead}-0.{WRITING}"),
        format!(".out.1-0.{WRITING}"),
        format!(".out.notes.{WRITING}"),
        format!(".out.{dead}-0.txt"),
    ];
    kept.iter().for_each(|name| put(&base.path().join(name), ""));
    let first = StagedFolder::new(&target, false).unwrap();
    let second = StagedFolder::new(&target, false).unwrap();
    assert!(first.path().exists() && first.path() != second.path());
    drop((first, second));
    let mut expected = kept.to_vec();
    expected.sort();
    assert_eq!(names(base.path()), expected);
}

#[cfg(target_os = "linux")]
#[test]
fn a_run_killed_between_its_renames_does_not_lose_the_old_output() {
    let base = tempfile::tempdir().unwrap();
    let target = base.path().join("out");
    result_folder(&base.path().join(format!(".out.{}-1.{REPLACED}", ended())), "old");
    drop(StagedFolder::new(&target, true).unwrap());
    assert_eq!(names(base.path()), ["out"]);
    assert_eq!(fs::read_to_string(target.join("content")).unwrap(), "old");
}

#[test]
fn a_bare_name_lands_in_the_working_folder() {
    assert_eq!(parts(Path::new("out")).unwrap(), (PathBuf::from("."), OsStr::new("out")));
}
