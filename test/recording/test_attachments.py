# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Goal pictures and model cards are attached to recordings, and come out of them safely."""

from dataclasses import replace
import struct

import cv2
from made_episodes import make_episode, write_bag
from mcap.reader import make_reader, NonSeekingReader
from mcap.writer import Writer
import numpy as np
from rosbags.highlevel import AnyReader
from tap_ros.cli import main
from tap_ros.recording import attachments
from tap_ros.recording.attachments import MAX_CARD_BYTES, read_attachments, save_attachment
from tap_ros.recording.messages import encode
from tap_ros.recording.writer import BagWriter

IMAGE, STRING = 'sensor_msgs/msg/Image', 'std_msgs/msg/String'
NAMES = ('../../evil.png', '/etc/passwd', '..', '.', '', 'a\\..\\b.png', '.bashrc', '-rf',
         'x' * 300 + '.png', 'goal.png', 'goal.png', 'new\nline\x1b[31m.txt', '\u202egnp.md')


def picture(value=7, stamp=3, side=8, **changes):
    """Encode a goal picture."""
    return encode(IMAGE, {
        'header': {'stamp': {'sec': stamp}}, 'height': side, 'width': side, 'encoding': 'rgb8',
        'step': 3 * side, 'data': np.full(3 * side * side, value, np.uint8), **changes})


def record(folder, *messages):
    """Write (topic, type, data) one second after another; return the only file."""
    with BagWriter(folder) as writer:
        for second, (topic, kind, data) in enumerate(messages):
            writer.write_raw(topic, kind, data, second * 10**9)
    file, = folder.glob('*.mcap')
    return file


def attach(path, *found, finish=True):
    """Write a file as another program does: only attachments, of (name, type, data)."""
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start('ros2')
        for name, kind, data in found:
            writer.add_attachment(0, 5, name, kind, data)
        if finish:
            writer.finish()
        else:
            writer.flush()
    return path


def goals(folder, *values):
    """Record goal pictures of one colour each; return the only file."""
    return record(folder, *(('/goal/image', IMAGE, picture(value)) for value in values))


def test_each_goal_picture_is_attached_when_it_comes(tmp_path):
    found = list(read_attachments(goals(tmp_path / 'bag', 7, 7, 9)))
    assert [(each.name, each.media_type) for each in found] == [('goal.png', 'image/png')] * 2
    assert [each.log_time for each in found] == [0, 2 * 10**9]
    for each, value in zip(found, (7, 9), strict=True):
        pixels = cv2.imdecode(np.frombuffer(each.data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        np.testing.assert_array_equal(pixels, np.full((8, 8, 3), value))


def test_other_readers_find_messages_and_attachments(tmp_path):
    file = goals(tmp_path / 'bag', 5, 6, 7)
    ours = list(read_attachments(file))
    for reader in (make_reader, NonSeekingReader):
        with file.open('rb') as stream:
            found = list(reader(stream, validate_crcs=True).iter_attachments())
        assert [(a.name, a.log_time, a.data) for a in found] == [
            (a.name, a.log_time, a.data) for a in ours]
        assert [a.create_time for a in found] == [3 * 10**9] * 3
    with AnyReader([file.parent]) as reader:
        assert sum(1 for _ in reader.messages()) == reader.message_count == 3


def test_model_cards_are_attached_with_the_names_of_their_nodes(tmp_path):
    card = encode(STRING, {'data': '# predictor.safetensors \u00e4'})
    file = record(tmp_path / 'bag', ('/predictor_node/model_card', STRING, card),
                  ('/predictor_node/model_card', STRING, card),
                  ('/robot1/predictor_node/model_card', STRING, card),
                  ('/robot1/goal/image', IMAGE, picture()), ('/status', STRING, card))
    assert [(each.name, each.log_time) for each in read_attachments(file)] == [
        ('predictor_node_model_card.md', 0), ('robot1_predictor_node_model_card.md', 2 * 10**9),
        ('robot1_goal.png', 3 * 10**9)]
    assert next(read_attachments(file)).data.decode() == '# predictor.safetensors \u00e4'


def test_what_cannot_be_attached_is_recorded_as_ever(tmp_path):
    bad = [
        (IMAGE, picture(data=b'')), (IMAGE, picture(encoding='depth')), (IMAGE, b'nonsense'),
        (IMAGE, picture(height=0, width=0, step=0, data=b'')),
        (IMAGE, picture(height=1, width=40_000, step=120_000, data=bytes(120_000))),
        (STRING, encode(STRING, {'data': ''})), (STRING, b'\0\1\0\0\xff\xff\xff\xff'),
        (STRING, encode(STRING, {'data': 'x' * (MAX_CARD_BYTES + 1)})), (STRING, picture())]
    file = record(tmp_path / 'bag', *(
        ('/goal/image' if kind == IMAGE else '/predictor_node/model_card', kind, data)
        for kind, data in bad), ('/goal/image', IMAGE, picture()))
    assert [each.log_time for each in read_attachments(file)] == [len(bad) * 10**9]
    with file.open('rb') as stream:
        assert [m.data for _, _, m in make_reader(stream).iter_messages()] == [
            *(data for _, data in bad), picture()]


def test_a_recording_does_not_fill_with_attachments(tmp_path, monkeypatch):
    monkeypatch.setattr('tap_ros.recording.attachments.MAX_NEW_BYTES', 1000)
    noise = np.random.default_rng(0).integers(0, 256, (9, 192), np.uint8)
    file = record(tmp_path / 'bag', *(('/goal/image', IMAGE, picture(data=d)) for d in noise))
    found = list(read_attachments(file))
    assert 0 < len(found) < 9 and sum(each.size for each in found) <= 1000
    with file.open('rb') as stream:
        assert len(list(make_reader(stream).iter_messages())) == 9


def test_names_never_lead_out_of_the_folder_and_nothing_is_replaced(tmp_path):
    file = attach(tmp_path / 'a.mcap', *((name, 'text/plain', name.encode()) for name in NAMES))
    folder = tmp_path / 'deep' / 'out'
    (folder / 'evil.png').mkdir(parents=True)
    (folder / 'goal.png').write_text('precious')
    (folder / 'passwd').symlink_to(tmp_path / 'elsewhere')
    before = sorted(tmp_path.rglob('*'))
    written = [save_attachment(each, folder) for each in read_attachments(file)]
    assert sorted(tmp_path.rglob('*')) == sorted([*before, *written])
    assert len(set(written)) == len(NAMES)
    assert (folder / 'goal.png').read_text() == 'precious'
    for path, name in zip(written, NAMES, strict=True):
        assert path.parent == folder and path.read_bytes() == name.encode()
        assert path.name.isascii() and path.name.isprintable() and path.name[0] not in '.-'
        assert len(path.name) <= 110
    assert {'evil-2.png', 'passwd-2', 'goal-2.png', 'goal-3.png'} <= {p.name for p in written}


def test_a_damaged_attachment_is_told_and_all_else_is_used(tmp_path, capsys):
    file = goals(tmp_path / 'bag', *range(7))
    whole = list(read_attachments(file))
    data = bytearray(file.read_bytes())
    data[data.index(whole[1].data) + 9] ^= 1
    file.write_bytes(data)
    found = list(read_attachments(file))
    assert found[1] == replace(whole[1], data=None, damage=found[1].damage)
    assert 'checksum' in found[1].damage
    assert found[:1] + found[2:] == whole[:1] + whole[2:]
    with file.open('rb') as stream:
        assert len(list(make_reader(stream).iter_messages())) == 7
    main(['inspect', str(file), '--attachments', str(tmp_path / 'out')])
    said = capsys.readouterr().out
    assert '6 of 7 written' in said and said.count('checksum is wrong') == 1
    assert len(list((tmp_path / 'out').iterdir())) == 6


def test_attachments_of_a_file_that_was_not_finished_are_found(tmp_path):
    file = goals(tmp_path / 'bag', *range(7))
    whole, data = list(read_attachments(file)), file.read_bytes()
    end = data.index(whole[3].data) + whole[3].size + 4
    for length in (end, end - 1):
        file.write_bytes(data[:length])
        assert list(read_attachments(file)) == whole[:4 if length == end else 3]


def test_attachments_behind_a_hole_are_told(tmp_path, monkeypatch):
    file = attach(tmp_path / 'a.mcap', ('a', 'b', b'x' * 5000), ('c', 'd', b'y'), ('e', 'f', b''))
    whole, data = list(read_attachments(file)), file.read_bytes()
    monkeypatch.setattr(attachments, 'MAX_BYTES', 4000)
    assert [each.data for each in read_attachments(file)] == [None, b'y', b'']
    assert '4000' in next(read_attachments(file)).damage
    hole = data.index(b'd' + struct.pack('<Q', 1)) + 3
    file.write_bytes(data[:hole] + data[hole + 2:])
    monkeypatch.undo()
    found = list(read_attachments(file))
    assert found[0] == whole[0] and 'attachments behind it are not found' in found[-1].damage


def test_inspect_takes_attachments_out_of_what_cannot_be_trained_on(tmp_path, capsys):
    file = attach(tmp_path / 'a.mcap', *[('../a\x1b[31m.txt', 'text/plain', b'hello')] * 25)
    out = tmp_path / 'out'
    arguments = ['inspect', str(file), '--attachments', str(out)]
    assert main(arguments) == 1  # without pictures
    said = capsys.readouterr()
    assert '\x1b' not in said.out and r'../a\x1b[31m.txt  text/plain  5 bytes' in said.out
    assert 'and 5 more' in said.out and '25 of 25 written' in said.out
    assert 'no topic ends in /camera/image_raw' in said.err
    assert [path.read_bytes() for path in out.iterdir()] == [b'hello'] * 25
    assert main(arguments) == 1
    assert 'not empty' in capsys.readouterr().err
    assert len(list(out.iterdir())) == 25


def test_a_bag_without_attachments_says_nothing_of_them(tmp_path, capsys):
    bag = write_bag(tmp_path / 'bag', [make_episode(goal_frame=None, size=(16, 16))] * 2)
    main(['inspect', str(bag)])
    assert '\nattachments' not in capsys.readouterr().out
    main(['inspect', str(bag), '--attachments', str(tmp_path / 'out')])
    assert '0 of 0 written' in capsys.readouterr().out
