from glob import glob

from setuptools import find_packages, setup

package_name = 'ps_calibration'

setup(
    name=package_name,
    version='0.1.0',
    packages=find_packages(exclude=['test']),
    package_data={package_name: ['py.typed', 'data/*', 'templates/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + package_name]),
        ('share/' + package_name, ['package.xml']),
        ('share/' + package_name + '/config', glob('config/*.yaml')),
        ('share/' + package_name + '/launch', glob('launch/*.launch.py')),
    ],
    install_requires=['setuptools'],
    zip_safe=True,
    maintainer='ps_head maintainers',
    maintainer_email='maintainers@ps-head.invalid',
    description='Half-ring calibration of the head.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'ring_calibration = ps_calibration.nodes.ring_calibration:main',
            'ps_calibrate = ps_calibration.cli.ps_calibrate:main',
            'ps_ring_target = ps_calibration.cli.ps_ring_target:main',
        ],
    },
)
