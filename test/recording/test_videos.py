# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Videos: AV1, the rate at which frames are taken, and what is kept of full pictures."""

import base64
from pathlib import Path
import sys
import zlib

import numpy as np
import pytest
from tap_ros.base.contract import MAX_PICTURE_BYTES
from tap_ros.base.errors import RecordingError
from tap_ros.recording.cache import open_recordings
from tap_ros.recording.formats import videos
from tap_ros.recording.formats.lerobot_format import Video
from tap_ros.recording.formats.pictures import Skipped
from tap_ros.recording.formats.videos import at_rate, video_frames
from tap_ros.recording.mcap_file import McapFile
from test_importers import make_frames, run_import, write_video

# Three frames of 64x64 pixels, of the greys 40, 100 and 160, at 10 a second, in MP4.
AV1 = zlib.decompress(base64.b85decode(
    'c-nna%}T>S5dM-XRPmr#wMdl+6+Eb<QM`C5=%IoqK@TFx)=e;&Z9=jJ^rW5y5u|S+9()B4f+uf2gl|!2(^S{`Gwk'
    'G>-JPBP0I)oH7Wqji022yXYS#!I5v|q$6usDW33ml&a(I{|^RaV#XcwK)QM{UCn^z_&88=(2b!TG1M76y&^J0`5m'
    'JK`sQ#)_YxNQy$Rk41jTwnxfRibI*8Ym2jFigp0Akt%wZ&Y{(j71nw>x+!<TK)Sv{v~p6uE?03kbEFdGM|N?*2pj'
    'Z_w%dY`ey)Dm&=5(;s%NQdXd}B-Wm^r`-}uj@c!HvpvtuSoNbnlc@Xz*QlGoJ<{s_C25a%aRXWC=@LL`UrBq}_^)'
    'RcvdspGH>uG6>oW_Bb2RNC?W<YW~kqOsyuGCcgQ3{oG9Sy?9pBnvC?sU|brL~PqO0_pv7l$aS=$kUm%T^rhGRld}'
    'O4_qeZ5vQ>i6Yg{6<6r&sPC+hqeXY;`kWEZ5-;X5**glgw=~9Ro^q*LwJ+QZ70u~wp;pE$iUK{wCBNJI`Fj~EgER'
    'F1uwHStS?aAh%QafI^8ugEYdZ'))


def levels(path):
    return [(round(at, 3), round(float(show().mean()))) for at, show in video_frames(path)]


def test_av1_is_decoded_by_pyav(tmp_path):
    pytest.importorskip('av')
    path = tmp_path / 'a.mp4'
    path.write_bytes(AV1)
    found = levels(path)
    assert [at for at, _ in found] == [0.0, 0.1, 0.2]
    assert np.abs(np.array([level for _, level in found]) - (40, 100, 160)).max() < 3
    path.write_bytes(AV1[:-40])
    assert len(levels(path)) in (2, 3)  # a frame that is cut off
    path.write_bytes(AV1[:300])
    with pytest.raises(RecordingError, match='holds no pictures|is no video'):
        levels(path)


def test_a_video_of_pictures_too_large_is_refused(tmp_path, monkeypatch):
    pytest.importorskip('av')
    path = tmp_path / 'a.mp4'
    path.write_bytes(AV1)
    monkeypatch.setattr(videos, 'MAX_PICTURE_BYTES', 64 * 64 * 3 - 1)
    with pytest.raises(RecordingError, match='64x64 pixels are more than'):
        next(videos._by_pyav(path, ''))
    assert MAX_PICTURE_BYTES > 64 * 64 * 3


def test_without_pyav_the_most_frequent_cause_is_named_first_with_its_count(
        tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, 'av', None)
    for name in 'abc':
        (tmp_path / f'{name}.mp4').write_bytes(AV1)
    for name in '01':
        (tmp_path / f'{name}.mp4').write_bytes(b'none')
    code, said = run_import(capsys, 'import-video', tmp_path, '--out', tmp_path / 'bag')
    assert code == 1 and '3 videos: ' in said and '2 videos: ' in said
    assert said.index('3 videos: ') < said.index('2 videos: ')
    assert 'is AV1, as LeRobot records it' in said and 'pip install av' in said
    skipped = Skipped()
    for number in range(100):  # those that are missing are noted first
        skipped.note('needs PyAV' if number > 6 else 'is not there', 'episode', str(number))
    with pytest.raises(RecordingError, match='^bag: 93 episodes: needs PyAV.*; 7 episodes: is'):
        skipped.warn(Path('bag'), is_empty=True)


def test_frames_are_taken_at_a_rate(tmp_path, capsys):
    frames = [(t / 30, t) for t in range(31)]
    assert list(at_rate(frames, 10)) == frames[::3]
    assert [t for _, t in at_rate(frames, 4)] == [0, 8, 15, 23, 30]
    for rate in (0, 30, 100):
        assert list(at_rate(frames, rate)) == frames
    shades = np.arange(0, 200, 20, np.uint8)
    write_video(tmp_path / 'a.mp4', np.broadcast_to(
        shades[:, None, None, None], (10, 48, 64, 3)), 10)
    for options, period in ((('--rate', 5), 0.2), (('--rate', 5, '--fps', 5), 0.2)):
        bag = tmp_path / f'bag{len(options)}'
        assert not run_import(capsys, 'import-video', tmp_path, '--out', bag, *options)[0]
        episode, = open_recordings(bag)
        step = 10 // len(episode)
        assert len(episode) == 5 if len(options) == 2 else 10
        np.testing.assert_allclose(np.diff(episode.stamps), period * 1e9)
        assert np.abs(episode.frames.mean((1, 2, 3)) - shades[::step]).max() < 5
    code, said = run_import(
        capsys, 'import-video', tmp_path, '--out', tmp_path / 'c', '--rate', -1)
    assert code == 1 and '--rate -1.0: expected more than 0' in said


def test_full_pictures_of_videos_are_kept_as_jpeg_and_scaled_ones_exactly(tmp_path, capsys):
    write_video(tmp_path / 'a.mp4', make_frames(0, 4, 4).repeat(16, 1).repeat(16, 2), 10)
    exact = np.stack([show() for _, show in video_frames(tmp_path / 'a.mp4')])
    kinds = {}
    for size in (0, 64):
        bag = tmp_path / f'bag{size}'
        assert not run_import(
            capsys, 'import-video', tmp_path / 'a.mp4', '--out', bag, '--size', size)[0]
        kinds[size] = [topic for topic, _ in McapFile(bag / f'bag{size}_0.mcap').counts()
                       if 'image' in topic]
        off = np.abs(open_recordings(bag)[0].frames.astype(int) - exact)
        assert off.mean() < 4 if not size else not off.any()
    assert kinds == {0: ['/camera/image_raw/compressed'], 64: ['/camera/image_raw']}


def test_a_frame_is_shown_only_where_it_is_near_what_is_asked_for():
    shown, last = [], []

    def frames(times):
        for n, at in enumerate(times):
            def show(n=n):
                assert last == [n]  # as OpenCV shows the last one only
                shown.append(n)
                return np.full((1, 1, 3), n)
            last[:] = [n]
            yield at, show

    video = Video(Path('v'), frames([n / 30 for n in range(90)]), 1 / 30)
    for seconds in (0, 0.5, 1.0, 1.02, 2.5):
        at, picture = video.at(seconds)
        assert abs(at - seconds) < 0.02 and picture[0, 0, 0] == round(at * 30)
    assert len(shown) < 20
    shown.clear()
    video = Video(Path('v'), frames([0, 0.1, 2.0, 2.1]), 0.1)  # frames are missing between
    assert [video.at(s)[0] for s in (0, 0.1, 0.2, 1.9, 2.0, 2.1)] == [0, 0.1, 0.1, 2.0, 2.0, 2.1]
    assert video.now[1] is not None


def test_a_camera_that_no_video_is_named_after_is_refused_with_their_names(tmp_path, capsys):
    for demonstration in ('1', '2'):
        (tmp_path / 'in' / demonstration).mkdir(parents=True)
        for camera in ('side', 'top'):
            write_video(tmp_path / 'in' / demonstration / f'{camera}.mp4', make_frames(3), 10)
    code, said = run_import(capsys, 'import-video', tmp_path / 'in', '--out', tmp_path / 'bag',
                            '--camera', 'front')
    assert code == 1 and 'holds no video of that name; expected one of side, top' in said
    assert not (tmp_path / 'bag').exists()
