use proptest::prelude::*;

use super::*;

fn read(bytes: &[u8]) -> Pickle {
    Pickle::read(bytes, u64::MAX).unwrap()
}

#[test]
fn values_pickled_by_python_are_read() {
    // pickle.dumps(({"a": [1, -2, 300, 70000, 2**40], "b": (None, True, 0.5)}, "é"), 2)
    let bytes = b"\x80\x02}q\x00(X\x01\x00\x00\x00aq\x01]q\x02(K\x01J\xfe\xff\xff\xffM,\x01Jp\x11\x01\x00\x8a\x06\x00\x00\x00\x00\x00\x01eX\x01\x00\x00\x00bq\x03N\x88G?\xe0\x00\x00\x00\x00\x00\x00\x87q\x04uX\x02\x00\x00\x00\xc3\xa9q\x05\x86q\x06.";
    let pickle = read(bytes);
    let &[dict, text] = pickle.elements(pickle.root()).unwrap() else { panic!("a pair") };
    assert_eq!(pickle.text(text), Some("é"));
    let numbers = pickle.elements(pickle.item(dict, "a").unwrap()).unwrap();
    let numbers: Vec<i64> = numbers.iter().map(|&id| pickle.int(id).unwrap()).collect();
    assert_eq!(numbers, [1, -2, 300, 70_000, 1 << 40]);
    let others = pickle.elements(pickle.item(dict, "b").unwrap()).unwrap();
    let others: Vec<&Node> = others.iter().map(|&id| pickle.node(id)).collect();
    assert_eq!(others, [&Node::None, &Node::Bool(true), &Node::Float(0.5)]);
    assert_eq!(pickle.describe(dict), "a dict of 2: a, b");
}

#[test]
fn replaced_numbers_keep_their_positions() {
    // pickle.dumps((7, "x", 7), 4): has a FRAME instruction and a memo (table of values for later reference).
    let bytes = b"\x80\x04\x95\x0b\x00\x00\x00\x00\x00\x00\x00K\x07\x8c\x01x\x94K\x07\x87\x94.";
    let pickle = read(bytes);
    let elements = pickle.elements(pickle.root()).unwrap().to_vec();
    let Node::Int(7, at) = pickle.node(elements[2]) else { panic!("a number") };
    for number in [0, 255, 256, 65_535, 65_536, (1 << 31) - 1, 1 << 31, i64::MAX as u64] {
        let written = pickle.with_numbers(bytes, &BTreeMap::from([((at.start as usize, at.end as usize), number)]));
        let again = read(&written);
        let found = again.elements(again.root()).unwrap();
        assert_eq!((again.int(found[0]), again.text(found[1])), (Some(7), Some("x")));
        assert_eq!(again.int(found[2]), Some(number as i64));
    }
}

#[test]
fn calls_are_not_executed_and_shared_nodes_exist_once() {
    let bytes = b"\x80\x02cposix\nsystem\nX\x04\x00\x00\x00exit\x85R.";
    let pickle = read(bytes);
    assert_eq!(pickle.call(pickle.root()).unwrap().0, "posix.system");
    // A list of two references to a list of two references …: 2^60 paths, but one node for each list.
    let mut bytes = b"\x80\x02]q\x00".to_vec();
    for level in 0..60u8 {
        bytes.extend([b']', b'q', level + 1, b'(', b'h', level, b'h', level, b'e']);
    }
    bytes.push(b'.');
    assert_eq!(read(&bytes).ids().len(), 61);
    // A list that contains itself.
    let circle = read(b"\x80\x02]q\x00h\x00a.");
    assert_eq!(circle.elements(circle.root()), Some(&[circle.root()][..]));
}

#[test]
fn nesting_is_limited_for_every_instruction() {
    let deepest = usize::from(MAX_DEPTH);
    let tuples = |depth: usize| [b")".to_vec(), b"\x85".repeat(depth - 1), b".".to_vec()].concat();
    assert_eq!(read(&tuples(deepest)).ids().len(), deepest);
    let calls = [b"cx\ny\n".to_vec(), b")R".repeat(200), b".".to_vec()].concat();
    let appended = [b"]".repeat(200), b"a".repeat(199), b".".to_vec()].concat();
    let marks = [b"(".repeat(200), b"t".repeat(200), b".".to_vec()].concat();
    let outside = [b"N".to_vec(), b"Q".repeat(200), b".".to_vec()].concat();
    for bytes in [tuples(deepest + 1), calls, appended, marks, outside] {
        match Pickle::read(&bytes, u64::MAX) {
            Err(PickleError::TooMuch(_, expected, _)) => assert!(expected.contains("nested"), "{expected}"),
            other => panic!("{other:?}"),
        }
    }
}

/// Returns pickles of about `size` bytes, each with a name for messages. They would take far more memory than `size` if
/// they were read without limits.
fn bombs(size: usize) -> Vec<(&'static str, Vec<u8>)> {
    let long = [&[b'X'][..], &(size as u32 / 2).to_le_bytes(), &b"x".repeat(size / 2)].concat();
    let flood = |piece: &[u8]| piece.repeat(size / piece.len());
    let memo = |k: u32| [&[b'r'][..], &k.to_le_bytes()].concat();
    vec![
        ("lists", flood(b"]")),
        ("dicts of one", flood(b"}NNs")),
        ("lists of one", flood(b"]Na")),
        ("tuples", flood(b"N\x85")),
        ("texts", flood(b"\x8c\x01a")),
        ("names", flood(b"ca\nb\n")),
        ("calls", flood(b"N)R")),
        ("memo", [b"N".to_vec(), (0..size as u32 / 5).flat_map(memo).collect()].concat()),
        ("stack", [b"Nq\x00".to_vec(), flood(b"h\x00")].concat()),
        ("shared list", [b"Nq\x00]".to_vec(), flood(b"h\x00a")].concat()),
        ("long names", [long, b"q\x00".to_vec(), flood(b"h\x00h\x00\x93")].concat()),
        ("frames", flood(b"\x95\0\0\0\0\0\0\0\0")),
    ]
}

#[test]
fn memory_is_limited_before_it_is_allocated() {
    for (name, bytes) in bombs(300_000) {
        let memory = 1 << 20;
        match Pickle::read(&bytes, memory) {
            // The bytes do not end with the instruction STOP.
            Err(PickleError::Malformed(at, found)) => {
                assert!(at == bytes.len() && found.contains("end"), "{name}: {found}");
            }
            Err(PickleError::Memory(_, taken)) => assert!(taken > memory, "{name}: {taken}"),
            other => panic!("{name}: {other:?}"),
        }
    }
    let refused = |name: &str| {
        let bytes = bombs(300_000).into_iter().find(|bomb| bomb.0 == name).unwrap().1;
        matches!(Pickle::read(&bytes, 1 << 20), Err(PickleError::Memory(..)))
    };
    assert!(refused("lists") && refused("long names") && refused("memo") && refused("tuples"));
}

#[test]
fn instructions_are_limited() {
    let bytes = [b"(1".repeat(1 << 20), b"N.".to_vec()].concat();
    match Pickle::read(&bytes, u64::MAX) {
        Err(PickleError::TooMuch(at, expected, _)) => {
            assert!(at == 1 << 21 && expected.contains("2097152 instructions"), "{at}: {expected}");
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn memo_numbers_and_lengths_may_be_the_largest() {
    let kept = read(b"Nr\xff\xff\xff\xff0j\xff\xff\xff\xff.");
    assert_eq!(kept.node(kept.root()), &Node::None);
    for start in [
        &b"\x8b\xff\xff\xff\xff"[..],
        b"X\xff\xff\xff\xff",
        b"\x8d\xff\xff\xff\xff\xff\xff\xff\xff",
        b"\x8e\xff\xff\xff\xff\xff\xff\xff\x7f",
    ] {
        assert!(
            matches!(Pickle::read(start, u64::MAX), Err(PickleError::Malformed(_, found)) if found.contains("end"))
        );
    }
}

#[test]
fn malformed_pickles_are_refused_with_their_position() {
    for (bytes, at, found) in [
        (&b""[..], 0, "end"),
        (b"\x80\x02K", 3, "end"),
        (b"\x80\x02X\xff\xff\xff\xffab", 7, "end"),
        (b"\x80\x02(K\x010", 6, "end"),
        (b"\x80\x02\x85.", 2, "tuple"),
        (b"\x80\x02h\x00.", 2, "never stored"),
        (b"\x80\x02}K\x01K\x02.", 8, ""),
        (b"\x80\x02}(K\x01u.", 6, "key without"),
        (b"\x80\x02\xff.", 2, "0xff"),
        (b"\x80\x02t.", 3, "never begun"),
    ] {
        match Pickle::read(bytes, u64::MAX) {
            Err(PickleError::Malformed(place, said)) => {
                assert!(place == at && said.contains(found), "{bytes:?}: {place}, {said}");
            }
            Err(other) => panic!("{bytes:?}: {other:?}"),
            Ok(_) => assert!(found.is_empty(), "{bytes:?} was read"),
        }
    }
}

proptest! {
    #[test]
    fn any_bytes_are_read_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
        if let Ok(pickle) = Pickle::read(&bytes, u64::MAX) {
            pickle.ids().for_each(|id| drop(pickle.describe(id)));
            prop_assert!(pickle.ids().len() <= bytes.len());
        }
    }
}
